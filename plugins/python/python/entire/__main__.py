# SPDX-License-Identifier: MIT OR Apache-2.0
"""``python -m entire``: the command `entire`."""

from __future__ import annotations

import sys

from ._command import main

if __name__ == "__main__":
    sys.exit(main())
