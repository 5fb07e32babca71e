# SPDX-License-Identifier: MIT OR Apache-2.0
"""The frames of a session as columns, and as a picture for notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

_WIDTH, _HEIGHT, _GAP, _LEFT, _RIGHT, _TOP = 720, 170, 34, 58, 14, 26
_MOST = 600


class History:
    """Observed frames of a session, oldest first.

    Columns are accessed as attributes or by name: ``plan`` (number of the plan), ``target``, ``predicted``, ``upper``,
    ``measured`` (seconds), ``step`` (reference steps), ``image_sample_distance`` (pixels), ``reason`` and ``verdict``.
    Notebooks show a history as two plots: predicted and measured time with the target, and step times the square of
    ``image_sample_distance``. With twice this product, a frame has about half as many samples.

    Parameters
    ----------
    columns : mapping of str to array_like
    """

    def __init__(self, columns: Mapping[str, Any]) -> None:
        self.columns = dict(columns)

    def __len__(self) -> int:
        return len(self.columns["measured"])

    def __getitem__(self, name: str) -> Any:
        return self.columns[name]

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["columns"][name]
        except KeyError:
            raise AttributeError(f"a history has no column {name!r}") from None

    def relative_error(self) -> npt.NDArray[np.float64]:
        """Returns abs(measured - target) / target of every frame.

        Returns
        -------
        numpy.ndarray
            float64, shape (n,).
        """
        target = np.asarray(self.columns["target"], np.float64)
        error: npt.NDArray[np.float64] = (
            np.abs(np.asarray(self.columns["measured"], np.float64) - target) / target
        )
        return error

    def __repr__(self) -> str:
        if not len(self):
            return "History(no frames)"
        off = self.relative_error()
        late = np.mean(np.asarray(self.columns["measured"]) > 1.25 * np.asarray(self.columns["target"]))
        return (
            f"History({len(self)} frames, mean |measured - target| / target {off.mean():.3f}, "
            f"{100 * late:.1f} % over 1.25 x target)"
        )

    def svg(self) -> str:
        """Draws the history.

        Returns
        -------
        str
            An SVG element, which is also a complete SVG file.
        """
        return _svg(self)

    def _repr_html_(self) -> str:
        return f"<div>{self.svg()}<p>{escape(repr(self))}</p></div>"


def _ticks(high: float) -> list[float]:
    """Returns 0 and two to five evenly spaced round numbers up to `high`."""
    power = 10.0 ** np.floor(np.log10(high))
    step = next(m * power for m in (0.2, 0.5, 1.0, 2.0) if high / (m * power) <= 5)
    return [float(v) for v in np.arange(0, high * 1.0001, step)]


def _line(x: Any, y: Any, color: str, dash: str = "", width: float = 1.5) -> str:
    """SVG path through the points (x, y), with gaps where y is not finite."""
    text: list[str] = []
    for a, b in zip(x, y):
        text.append("M" if not text or text[-1] == "" else "L")
        if not np.isfinite(b):
            text[-1] = ""
            continue
        text[-1] += f"{a:.1f} {b:.1f}"
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    path = " ".join(t for t in text if t)
    return f'<path d="{path}" fill="none" stroke="{color}" stroke-width="{width}"{dashes}/>'


def _svg(history: History) -> str:
    n = len(history)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {2 * _HEIGHT + _GAP + _TOP}" '
        f'width="{_WIDTH}" '
        f'font-family="sans-serif" font-size="11" role="img"><title>Frame times and steps</title>'
        f'<rect width="100%" height="100%" fill="white"/>'
    )
    if n == 0:
        return head + f'<text x="{_LEFT}" y="40" fill="#333">no frame was observed yet</text></svg>'
    keep = np.unique(np.linspace(0, n - 1, min(n, _MOST)).astype(int))
    wide = _WIDTH - _LEFT - _RIGHT
    x = _LEFT + wide * (keep / max(1, n - 1))
    measured = 1e3 * np.asarray(history["measured"], np.float64)[keep]
    predicted = 1e3 * np.asarray(history["predicted"], np.float64)[keep]
    target = 1e3 * np.asarray(history["target"], np.float64)[keep]
    coarsening = (np.asarray(history["step"]) * np.asarray(history["image_sample_distance"]) ** 2)[keep]
    parts = [head]
    series = (
        (
            "milliseconds",
            _TOP,
            [(predicted, "#d95f02", ""), (measured, "#1b6ca8", ""), (target, "#555", "5 3")],
        ),
        ("step &#215; distance&#178;", _TOP + _HEIGHT + _GAP, [(coarsening, "#2a7f3f", "")]),
    )
    for label, top, lines in series:
        finite = np.concatenate([y[np.isfinite(y)] for y, _, _ in lines])
        # The scale ends at the 99th percentile, so that an outlier does not compress the other values.
        high = 1.1 * max(float(np.percentile(finite, 99)), float(np.nanmedian(lines[-1][0])), 1e-6)
        tall = _HEIGHT - 20

        def at(y: Any, top: float = top, high: float = high, tall: float = tall) -> Any:
            return top + tall - tall * np.clip(y, 0, high) / high

        for tick in _ticks(high):
            parts.append(
                f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{at(tick):.1f}" y2="{at(tick):.1f}" '
                f'stroke="#e4e4e4"/>'
                f'<text x="{_LEFT - 6}" y="{at(tick) + 4:.1f}" text-anchor="end" fill="#333">{tick:g}</text>'
            )
        parts.extend(_line(x, at(y), color, dash) for y, color, dash in lines)
        parts.append(
            f'<text x="14" y="{top + tall / 2:.0f}" fill="#333" text-anchor="middle" '
            f'transform="rotate(-90 14 {top + tall / 2:.0f})">{label}</text>'
        )
    names = (("predicted", "#d95f02"), ("measured", "#1b6ca8"), ("target", "#555"))
    for i, (name, color) in enumerate(names):
        at_x = _LEFT + 90 * i
        parts.append(
            f'<rect x="{at_x}" y="9" width="14" height="3" fill="{color}"/>'
            f'<text x="{at_x + 19}" y="14" fill="#333">{name}</text>'
        )
    bottom = 2 * _HEIGHT + _GAP + _TOP - 6
    parts.append(
        f'<text x="{_LEFT + wide / 2}" y="{bottom}" fill="#333" text-anchor="middle">frame (of '
        f'{n})</text></svg>'
    )
    return "".join(parts)
