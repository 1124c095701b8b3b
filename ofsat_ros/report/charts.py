# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Small charts over time, as SVG that takes its colours from the page.

Made here, and not by a plotting library, since a report holds hundreds: one of these weighs a few
KB, is drawn in no time, follows the page's light and dark, and its words stay words.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# In the units of the drawing, which the page shows at about one CSS pixel each.
_WIDTH, _HEIGHT = 290, 176
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 8, 8, 24
# Points that a line has at most: of more, each bin's lowest and highest, and no bars.
_POINTS = 400
_TICKS = 5


@dataclass(frozen=True)
class Series:
    """One line of a chart.

    Attributes
    ----------
    name : str
        For the legend; empty for none.
    values : array
        One for each time; NaN leaves a gap.
    style : str
        CSS class, which gives the colour.
    dots : bool
        Dots instead of a line.
    errors : array or None
        Half the length of a bar through each dot.
    """

    name: str
    values: ArrayLike
    style: str = "s0"
    dots: bool = False
    errors: ArrayLike | None = None


def chart(
    times: ArrayLike,
    series: Sequence[Series],
    unit_of_time: str,
    *,
    band: ArrayLike | None = None,
    from_zero: bool = False,
    upside_down: bool = False,
    label: str = "",
) -> str:
    """Draw series over time.

    Parameters
    ----------
    times : (N,) array
    series : sequence of Series
    unit_of_time : str
        Written at the axis's end.
    band : (N,) array, optional
        A band of plus and minus this around zero.
    from_zero : bool
        Whether the axis of values includes zero.
    upside_down : bool
        Whether values grow downwards, as magnitudes do.
    label : str
        What it shows, for those who cannot see it.

    Returns
    -------
    str
        The ``svg`` element; empty if there is no value to show.
    """
    t = np.asarray(times, float)
    every = [np.asarray(one.values, float) for one in series]
    extent = np.concatenate([*every, np.zeros(1)] if from_zero or band is not None else every)
    if band is not None:
        extent = np.concatenate([extent, np.asarray(band, float), -np.asarray(band, float)])
    extent = extent[np.isfinite(extent)]
    if not len(extent) or not len(t):
        return ""
    low, high = _padded(float(extent.min()), float(extent.max()), from_zero)
    x = _Axis(
        float(t[0]), float(t[-1]) if t[-1] > t[0] else float(t[0]) + 1, _LEFT, _WIDTH - _RIGHT
    )
    ends = (_TOP, _HEIGHT - _BOTTOM) if upside_down else (_HEIGHT - _BOTTOM, _TOP)
    y = _Axis(low, high, *ends)
    parts = [_grid(x, y, unit_of_time)]
    if band is not None:
        parts.append(_band(x(t), y(np.asarray(band, float)), y(-np.asarray(band, float))))
    for one, values in zip(series, every, strict=True):
        if one.errors is not None and len(t) <= _POINTS:
            spread = np.asarray(one.errors, float)
            parts.append(_bars(x(t), y(values - spread), y(values + spread), one.style))
        parts.append(_line(x(t), y(values), one.style, one.dots))
    words = f' role="img" aria-label="{escape(label)}"' if label else ""
    return f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}"{words}>{"".join(parts)}</svg>'


def sparkline(values: ArrayLike, style: str) -> str:
    """Draw values in a line of text."""
    shown = np.asarray(values, float)
    if np.count_nonzero(np.isfinite(shown)) < 2:
        return ""
    low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
    y = _Axis(low, high if high > low else low + 1, 20, 2)
    line = _line(np.linspace(2, 98, len(shown)), y(shown), style, False)
    return f'<svg class="spark" viewBox="0 0 100 22" aria-hidden="true">{line}</svg>'


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    start: float
    end: float

    def __call__(self, values: Array) -> Array:
        return self.start + (values - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[tuple[float, str]]:
        """Places and words of round numbers along it."""
        step = (self.high - self.low) / _TICKS
        power = 10.0 ** math.floor(math.log10(step))
        step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= step)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        places = max(0, -math.floor(math.log10(step) + 1e-9))
        if not math.isclose(step, round(step, places), rel_tol=1e-6):
            places += 1  # 2.5
        values = [k * step for k in range(first, last + 1)]
        return [
            (float(self(np.array(v))), f"{v + 0.0:,.{places}f}".replace("-", "\u2212"))
            for v in values
        ]


def _padded(low: float, high: float, from_zero: bool) -> tuple[float, float]:
    size = max(abs(low), abs(high))
    if high - low <= 1e-9 * size or high == low:  # all the same
        pad = 0.1 * size if size else 1.0
        low, high = low - pad, high + pad
    pad = 0.07 * (high - low)
    return (0.0 if from_zero and low >= 0 else low - pad), high + pad


def _grid(x: _Axis, y: _Axis, unit: str) -> str:
    lines, words = [], []
    base = _HEIGHT - _BOTTOM
    for at, text in y.ticks():
        lines.append(f"M{_LEFT} {at:.1f}H{_WIDTH - _RIGHT}")
        words.append(f'<text x="{_LEFT - 6}" y="{at + 3.5:.1f}" class="v">{text}</text>')
    for at, text in x.ticks():
        if at < _WIDTH - _RIGHT - 26 - 7 * len(unit):
            words.append(f'<text x="{at:.1f}" y="{base + 16}" class="t">{text}</text>')
    words.append(f'<text x="{_WIDTH - _RIGHT}" y="{base + 16}" class="v">{escape(unit)}</text>')
    return f'<path class="grid" d="{"".join(lines)}"/>{"".join(words)}'


def _band(x: Array, high: Array, low: Array) -> str:
    known = np.flatnonzero(np.isfinite(high))
    known = known[:: -(-len(known) // _POINTS) or 1]
    if len(known) < 2:
        return ""
    points = [*zip(x[known], high[known], strict=True)]
    points += [*zip(x[known][::-1], low[known][::-1], strict=True)]
    outline = "L".join(f"{a:.1f} {b:.1f}" for a, b in points)
    return f'<path class="band" d="M{outline}Z"/>'


def _bars(x: Array, low: Array, high: Array, style: str) -> str:
    ends = np.clip(np.column_stack([low, high]), _TOP, _HEIGHT - _BOTTOM)
    drawn = [
        f"M{a:.1f} {b:.1f}V{c:.1f}"
        for a, (b, c) in zip(x, ends, strict=True)
        if math.isfinite(b + c)
    ]
    return f'<path class="bar {style}" d="{"".join(drawn)}"/>'


def _line(x: Array, y: Array, style: str, dots: bool) -> str:
    x, y = _thinned(x, y)
    known = np.isfinite(y)
    pieces = []
    for i in np.flatnonzero(known):
        joined = i > 0 and known[i - 1] and not dots
        pieces.append(f"{'L' if joined else 'M'}{x[i]:.1f} {y[i]:.1f}")
        alone = dots or not ((i and known[i - 1]) or (i + 1 < len(y) and known[i + 1]))
        if alone:  # a line of no length is a dot: its ends are round
            pieces.append("h0")
    kind = "dots" if dots else "line"
    return f'<path class="{kind} {style}" d="{"".join(pieces)}"/>'


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Of many points, each bin's lowest and highest, so that none that stands out is lost."""
    if len(x) <= _POINTS:
        return x, y
    each = -(-len(x) // (_POINTS // 2))
    bins = np.full((-(-len(x) // each), each), np.nan)
    bins.flat[: len(y)] = y
    known = np.isfinite(bins)
    ends = [np.where(known, bins, np.inf).argmin(1), np.where(known, bins, -np.inf).argmax(1)]
    keep = np.unique(np.add(ends, np.arange(len(bins)) * each))
    return x[keep], y[keep]
