# SPDX-License-Identifier: MIT OR Apache-2.0
"""Bars: goals, each printed with its measured value and limit as `bar NAME VALUE LIMIT ok|short` (as lab/src/bars.rs).

A script names all of its bars before it measures any. If measuring ends early, each bar without a value is printed as `-`
and short, below a line with the reason.
"""
import contextlib
import sys
import traceback


class Bars:
    """The bars of a script, as a context manager that ends the process with status 1 if a bar is short.

    `asked` maps the name of each bar to its limit. A value must not exceed the limit; for a bar in `at_least`, it must
    not be below the limit.
    """

    def __init__(self, asked, at_least=()):
        self.asked, self.at_least = dict(asked), frozenset(at_least)
        self.left, self.short = dict(asked), []
        if not asked:
            sys.exit("no bar is selected: see --help for names")

    def found(self, name, value, note="", limit=None):
        """Prints a bar and returns True if it is met. `value` is None or NaN if it was not measured. `limit`, if given,
        replaces the bar's limit in `asked`."""
        asked = self.left.pop(name)
        value = None if value != value else value
        limit = asked if limit is None else limit
        ok = value is not None and (value >= limit if name in self.at_least else value <= limit)
        if not ok:
            self.short.append(name)
        text = "-" if value is None else str(value) if isinstance(value, int) else f"{value:.4g}"
        print(f"bar {name} {text} {limit:g} {'ok' if ok else 'short'}{note and '  # ' + note}", flush=True)
        return ok

    def count(self, name, lines):
        """Prints a bar whose value is the number of `lines`. If the bar is short, prints the lines too."""
        if not self.found(name, len(lines)):
            for line in lines:
                print(f"  {line}", flush=True)

    def lacking(self, why, names=None):
        """Prints the bars in `names` (default: all) that have no value yet, as short. `why` names the cause and the
        remedy."""
        names = [n for n in (self.left if names is None else names) if n in self.left]
        if names:
            print(f"not measured: {why}", flush=True)
        for name in names:
            self.found(name, None)

    @contextlib.contextmanager
    def part(self, *names):
        """Context manager around the measurement of some bars. If it fails, the bars are short and the script continues."""
        why = "no value was found"
        try:
            yield
        except Exception as error:
            traceback.print_exc()
            why = f"{type(error).__name__}: {error}"
        self.lacking(why, names)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        why = "no value was found"
        if isinstance(error, SystemExit):
            why = str(error)
        elif kind is not None:
            traceback.print_exception(kind, error, trace)
            why = f"{kind.__name__}: {error}"
        self.lacking(why)
        if self.short:
            print(f"short: {', '.join(self.short)}", file=sys.stderr)
        ended_well = error is None or isinstance(error, SystemExit) and not error.code
        sys.exit(0 if ended_well and not self.short else 1)
