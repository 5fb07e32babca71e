# SPDX-License-Identifier: MIT OR Apache-2.0
"""The command `entire`."""

from __future__ import annotations

import signal
import sys

from ._native import command


def main() -> int:
    """Runs the command line with this process's arguments.

    Returns
    -------
    int
        Exit status.
    """
    # The command handles interrupts itself; Python's handler would run only after the command has returned.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return command(["entire", *sys.argv[1:]])
