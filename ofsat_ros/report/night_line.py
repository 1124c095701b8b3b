# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What happened when, hour by hour or night by night: strips over one axis of time, as SVG.

Beside charts.py, whose charts are small and count seconds: these are as wide as the page, show
what lasts, and their axis has clock times or dates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from html import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# In the units of the drawing.
_WIDTH, _LEFT, _RIGHT = 1000, 8, 8
_STRIP, _LANE, _HEAD, _AXIS = 54, 13, 24, 26
_LANES = 8
# Words on the axis, at most.
_TICKS = 9
_NS = 1_000_000_000
_MINUTE_S, _HOUR_S, _DAY_S = 60, 3600, 86400
_STEPS_S = (
    *(1, 2, 5, 10, 20, 30),
    *(_MINUTE_S * each for each in (1, 2, 5, 10, 20, 30)),
    *(_HOUR_S * each for each in (1, 2, 3, 6, 12)),
    *(_DAY_S * each for each in (1, 2, 5, 10, 20, 30, 60, 90, 180, 365, 730, 1826, 3652)),
)


@dataclass(frozen=True)
class Strip:
    """One thing over time: a value for each of some intervals.

    Attributes
    ----------
    name, meaning : str
        In the head.
    starts_ns, ends_ns : (N,) int64
        The intervals, ns UTC.
    values : (N,) float64 or None
        None: only that they were; they lie beside each other where they overlap.
    line : bool
        Draw a line, from interval to interval, instead of a bar for each.
    style : str
        CSS class, which gives the colour.
    """

    name: str
    meaning: str
    starts_ns: NDArray[np.int64]
    ends_ns: NDArray[np.int64]
    values: Array | None = None
    line: bool = False
    style: str = "s0"


def strips_over_time(strips: Sequence[Strip], label: str) -> str:
    """Draw strips, one below the other.

    Parameters
    ----------
    strips : sequence of Strip
        Those without an interval, or without a known value, are left out.
    label : str
        What it shows, for those who cannot see it.

    Returns
    -------
    str
        The ``svg`` element; empty if there is nothing to show.
    """
    shown = [one for one in strips if _is_known(one)]
    if not shown:
        return ""
    first = min(int(one.starts_ns.min()) for one in shown)
    last = max(int(one.ends_ns.max()) for one in shown)
    axis = _Axis(first, max(last, first + _NS))
    parts, y = [], 0.0
    for one in shown:
        parts.append(
            f'<text x="{_LEFT}" y="{y + 16:.0f}" class="head"><tspan>{escape(one.name)}</tspan>'
            f" {escape(one.meaning)}{_extent(one)}</text>"
        )
        y += _HEAD
        drawing, height = _lanes(one, axis, y) if one.values is None else _levels(one, axis, y)
        parts.append(drawing)
        y += height + 10
    grid = [f"M{at:.1f} 0V{y:.0f}" for at, _ in axis.ticks()]
    words = [
        f'<text x="{at:.1f}" y="{y + 17:.0f}" class="t">{text}</text>' for at, text in axis.ticks()
    ]
    return (
        f'<svg class="line-of-time" viewBox="0 0 {_WIDTH} {y + _AXIS:.0f}" role="img"'
        f' aria-label="{escape(label)}"><path class="grid" d="{"".join(grid)}"/>'
        f"{''.join(parts)}{''.join(words)}</svg>"
    )


def _is_known(strip: Strip) -> bool:
    if not len(strip.starts_ns):
        return False
    return strip.values is None or bool(np.isfinite(strip.values).any())


def _extent(strip: Strip) -> str:
    if strip.values is None:
        return ""
    return f" · up to {np.nanmax(strip.values):.4g}"


@dataclass(frozen=True)
class _Axis:
    first_ns: int
    last_ns: int

    def __call__(self, stamps_ns: NDArray[np.int64]) -> Array:
        share = (stamps_ns - self.first_ns) / (self.last_ns - self.first_ns)
        return np.asarray(_LEFT + share * (_WIDTH - _LEFT - _RIGHT), float)

    def ticks(self) -> list[tuple[float, str]]:
        """Places and words of round times along it."""
        span_s = (self.last_ns - self.first_ns) / _NS
        step_s = next((step for step in _STEPS_S if span_s / step <= _TICKS), _STEPS_S[-1])
        begin = datetime.fromtimestamp(self.first_ns // _NS, UTC)
        midnight = begin.replace(hour=0, minute=0, second=0, microsecond=0)
        skipped = -(-(begin - midnight).total_seconds() // step_s)
        at = midnight + timedelta(seconds=skipped * step_s)
        form = "%H:%M" if step_s < _DAY_S else "%Y-%m-%d"
        form += ":%S" * (step_s < _MINUTE_S)
        made = []
        while (stamp_ns := round(at.timestamp()) * _NS) <= self.last_ns:
            x = float(self(np.array(stamp_ns)))
            if 20 < x < _WIDTH - 30:  # room for the word
                made.append((x, f"{at:{form}}"))
            at += timedelta(seconds=step_s)
        return made


def _lanes(strip: Strip, axis: _Axis, top: float) -> tuple[str, float]:
    """Bars of one height, in the first lane that is free."""
    order = np.argsort(strip.starts_ns, kind="stable")
    free_ns: list[int] = []
    parts = []
    for start, end in zip(
        strip.starts_ns[order].tolist(), strip.ends_ns[order].tolist(), strict=True
    ):
        lane = next((i for i, until in enumerate(free_ns) if until <= start), len(free_ns))
        if lane == len(free_ns) and lane < _LANES:
            free_ns.append(end)
        lane = min(lane, _LANES - 1)
        free_ns[lane] = max(end, free_ns[lane])
        a, b = axis(np.array([start, end])).tolist()
        y = top + lane * _LANE
        parts.append(f"M{a:.1f} {y:.0f}H{max(b - 1, a + 1):.1f}v{_LANE - 3}H{a:.1f}z")
    return f'<path class="block {strip.style}" d="{"".join(parts)}"/>', len(free_ns) * _LANE


def _levels(strip: Strip, axis: _Axis, top: float) -> tuple[str, float]:
    """Bars or a line, from zero up."""
    assert strip.values is not None
    base = top + _STRIP
    highest = float(np.nanmax(strip.values)) or 1.0
    y = base - np.clip(strip.values / highest, 0, 1) * _STRIP
    starts, ends = axis(strip.starts_ns), axis(strip.ends_ns)
    ground = f'<path class="grid" d="M{_LEFT} {base:.0f}H{_WIDTH - _RIGHT}"/>'
    parts = []
    if not strip.line:
        for a, b, level in zip(starts, ends, y, strict=True):
            if level < base:  # neither NaN nor zero
                end = max(b - min(0.1 * (b - a), 1), a + 1)  # a gap tells bars from each other
                parts.append(f"M{a:.1f} {base:.0f}V{level:.1f}H{end:.1f}V{base:.0f}z")
        return f'{ground}<path class="block {strip.style}" d="{"".join(parts)}"/>', _STRIP
    before = -np.inf
    for a, b, level in zip(starts, ends, y, strict=True):
        if np.isnan(level):
            continue
        joined = before <= a + 0.5 * (b - a) and a - before <= b - a
        parts.append(
            f"{'L' if joined else 'M'}{(a + b) / 2:.1f} {level:.1f}{'' if joined else 'h0'}"
        )
        before = b
    return f'{ground}<path class="line {strip.style}" d="{"".join(parts)}"/>', _STRIP
