# SPDX-License-Identifier: MIT OR Apache-2.0
"""Server processes that are measured in turns: each answers a line on its standard input with a line `@@{json}`."""
import json
import os
import pathlib
import subprocess
import sys
import tempfile


def raise_priority(nice):
    """Raises the priority of this session: with the kernel's autogroups, niceness of a process acts only in its session."""
    try:
        os.setsid()
    except OSError:
        pass
    try:
        pathlib.Path("/proc/self/autogroup").write_text(str(nice))
    except OSError as error:
        print(f"priority of the session not raised: {error}", file=sys.stderr)


def thread_counts(threads):
    """Environment variables by which inference libraries and their servers run this many threads."""
    return {f"{name}_NUM_THREADS": str(threads) for name in ("RAYON", "RTEN", "OMP", "MKL")} | {"PEER_THREADS": str(threads)}


class Server:
    """A server process. `environment` is added to that of this process; `nice` is its niceness (negative: needs root)."""

    def __init__(self, command, environment=None, nice=0):
        raised = (lambda: os.setpriority(os.PRIO_PROCESS, 0, nice)) if nice else None
        self.said = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.said, text=True,
            env=os.environ | (environment or {}), preexec_fn=raised,
        )

    def answer(self):
        """The next answer; other lines are skipped. `{"err": reason}` if the process has ended."""
        for line in self.process.stdout:
            if line.startswith("@@"):
                return json.loads(line[2:])
        self.process.wait()
        self.said.seek(0)
        last = self.said.read().strip().splitlines()[-1:]
        return {"err": f"the server ended with {self.process.returncode}{': ' + last[0] if last else ''}"}

    def ask(self, line):
        """The answer to a line."""
        try:
            self.process.stdin.write(line + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass
        return self.answer()

    def end(self):
        try:
            self.process.stdin.close()
        except BrokenPipeError:
            pass
        self.process.wait()
