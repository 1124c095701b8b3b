# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Maps of the sky, as SVG: paths around their middle, and how many there were where.

North is up and east to the left, as one sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import count, takewhile

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.catalog.sphere import angles, cap_of, unit_vectors

Array = NDArray[np.float64]

# In the units of the drawing: a round map, and one of the whole sky.
_RADIUS, _WIDE, _HIGH = 300.0, 720.0, 360.0
_LEAST = np.radians(0.05)
# Between circles of declination, degrees, and lines of right ascension, minutes of time.
_DEC_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30)
_RA_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 180)
_LINES = 4  # in a radius, at most
_CELL_DEG = 6


def map_of_paths(paths: Sequence[tuple[str, str, Array, Array]], label: str) -> str:
    """Draw paths around their middle; distances from it are true.

    Parameters
    ----------
    paths : sequence of (style, link, (K,) float64, (K,) float64)
        CSS class, where a click leads (empty: nowhere), right ascensions and declinations in
        degrees; the great circle leads from each place to the next.
    label : str
        What it shows, for those who cannot see it.

    Returns
    -------
    str
        The ``svg`` element; empty without a path.
    """
    if not paths:
        return ""
    every = np.concatenate([unit_vectors(ra, dec) for _, _, ra, dec in paths])
    middle, _ = cap_of(every)
    # A drawing of less than the whole sphere, in which a direction has one place.
    radius = min(max(1.08 * float(angles(every, middle).max()), _LEAST), np.pi)
    view = _View(middle, radius)
    drawn = []
    for style, link, ra, dec in paths:
        path = _polyline(view(_filled(unit_vectors(ra, dec))))
        shape = f'<path class="{style}" d="{path}"/>'
        drawn.append(f'<a href="{escape(link)}">{shape}</a>' if link else shape)
    size = 2 * _RADIUS + 8
    corner = -_RADIUS - 4
    return (
        f'<svg class="sky-map view" viewBox="{corner:.0f} {corner:.0f} {size:.0f} {size:.0f}"'
        f' role="img" aria-label="{escape(label)}">'
        f'<clipPath id="horizon"><circle r="{_RADIUS:.0f}"/></clipPath>'
        f'<circle class="ground" r="{_RADIUS:.0f}"/>'
        f'<g clip-path="url(#horizon)">{_graticule(view)}{"".join(drawn)}</g></svg>'
    )


class _View:
    """Zenithal equidistant projection of unit vectors (N, 3) to the drawing (N, 2)."""

    def __init__(self, middle: Array, radius: float) -> None:
        self.middle, self.radius = middle, radius
        east = np.cross([0.0, 0.0, 1.0], middle)
        if np.linalg.norm(east) < 1e-9:  # a pole
            east = np.array([0.0, 1.0, 0.0])
        self._east = east / np.linalg.norm(east)
        self._north = np.cross(middle, self._east)

    def __call__(self, at: Array) -> Array:
        plane = np.column_stack([at @ self._east, at @ self._north])
        size = np.linalg.norm(plane, axis=1, keepdims=True)
        away = angles(at, self.middle)[:, None] / self.radius * _RADIUS
        return np.where(size > 0, plane / np.maximum(size, 1e-300), 0.0) * away * [-1.0, -1.0]


def _filled(at: Array) -> Array:
    """Places along great circles so near each other that straight lines join them."""
    steps = np.degrees(angles(at[1:], at[:-1])).astype(int) + 1
    starts, ends = (np.repeat(each, steps, axis=0) for each in (at[:-1], at[1:]))
    first = np.repeat(np.cumsum(steps) - steps, steps)
    share = ((np.arange(len(first)) - first + 1) / np.repeat(steps, steps))[:, None]
    between = starts * (1 - share) + ends * share
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    return np.concatenate([at[:1], between])


def _polyline(places: Array) -> str:
    points = "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
    return f"M{points}h0" if len(places) == 1 else f"M{points}"


def _graticule(view: _View) -> str:
    """Lines of right ascension and declination within reach, with words."""
    ra0 = float(np.degrees(np.arctan2(view.middle[1], view.middle[0]))) % 360
    dec0 = float(np.degrees(np.arcsin(np.clip(view.middle[2], -1, 1))))
    reach = float(np.degrees(view.radius))
    dec_step = next((step for step in _DEC_STEPS if reach / step <= _LINES), _DEC_STEPS[-1])
    low, high = max(dec0 - reach, -90.0), min(dec0 + reach, 90.0)
    # How far right ascensions reach: all round where a pole is in the map.
    ra_reach = 180.0
    if max(abs(low), abs(high)) < 90:
        ratio = np.sin(view.radius) / np.cos(np.radians(dec0))
        ra_reach = (
            float(np.degrees(np.arcsin(min(ratio, 1.0)))) if view.radius < np.pi / 2 else 180
        )
    ra_step = next((s for s in _RA_STEPS if ra_reach / (s / 4) <= _LINES), _RA_STEPS[-1]) / 4
    lines, words = [], []
    along = np.linspace(-ra_reach, ra_reach, 121) + ra0
    for dec in _rounds(low, high, dec_step):
        lines.append(_polyline(view(unit_vectors(along, np.full(along.shape, dec)))))
        words.append((ra0, dec, f"{dec + 0.0:+.4g}°".replace("-", "\u2212")))
    up = np.linspace(low, high, 61)
    for ra in _rounds(ra0 - ra_reach, ra0 + ra_reach - 1e-6, ra_step):
        lines.append(_polyline(view(unit_vectors(np.full(up.shape, ra), up))))
        words.append((ra, dec0, _hours(ra)))
    placed = [(view(unit_vectors([ra], [dec]))[0], text) for ra, dec, text in words]
    texts = [
        f'<text x="{x + 4:.1f}" y="{y - 4:.1f}">{text}</text>'
        for (x, y), text in placed
        if np.hypot(x, y) < 0.88 * _RADIUS
    ]
    return f'<path class="grid" d="{"".join(lines)}"/>{"".join(texts)}'


def _rounds(low: float, high: float, step: float) -> list[float]:
    """Multiples of a step within limits."""
    first = int(np.ceil(low / step - 1e-9))
    return list(takewhile(lambda value: value <= high + 1e-9, (k * step for k in count(first))))


def _hours(ra_deg: float) -> str:
    seconds = round(ra_deg % 360 * 240) % 86400
    words = f"{seconds // 3600}h"
    if seconds % 3600:
        words += f"{seconds // 60 % 60:02d}m"
    return words + f"{seconds % 60:02d}s" * bool(seconds % 60)


def map_of_counts(ra_deg: Array, dec_deg: Array, label: str) -> tuple[str, int]:
    """Draw how many directions there are in each part of the whole sky.

    Parameters
    ----------
    ra_deg, dec_deg : (N,) float64
    label : str
        What it shows, for those who cannot see it.

    Returns
    -------
    svg : str
        The ``svg`` element, in an equal-area (Hammer) projection around 0h; empty without a
        direction.
    most : int
        How many there are in the fullest cell, of about 6 degrees in square.
    """
    known = np.isfinite(ra_deg + dec_deg)
    if not known.any():
        return "", 0
    bands = 180 // _CELL_DEG
    band = np.clip((dec_deg[known] + 90) // _CELL_DEG, 0, bands - 1).astype(int)
    middles = np.radians((np.arange(bands) + 0.5) * _CELL_DEG - 90)
    in_band = np.maximum(np.round(360 / _CELL_DEG * np.cos(middles)), 3).astype(int)
    turn = (ra_deg[known] + 180) % 360 / 360
    cell = np.minimum((turn * in_band[band]).astype(int), in_band[band] - 1)
    filled, counts = np.unique(np.column_stack([band, cell]), axis=0, return_counts=True)
    most = int(counts.max())
    parts = []
    for (b, c), many in zip(filled.tolist(), counts.tolist(), strict=True):
        west, east = (360 * (c + k) / in_band[b] - 180 for k in (0, 1))
        south = _CELL_DEG * b - 90
        around = np.array(
            [(west, south), (east, south), (east, south + _CELL_DEG), (west, south + _CELL_DEG)]
        )
        strength = 0.15 + 0.85 * np.log1p(many) / np.log1p(most)
        outline = _polyline(_hammer(around[:, 0], around[:, 1]))
        parts.append(
            f'<path d="{outline}z" fill-opacity="{strength:.2f}"><title>{many}</title></path>'
        )
    up, along = np.linspace(-90, 90, 61), np.linspace(-180, 180, 121)
    lines = [_polyline(_hammer(np.full(61, float(ra)), up)) for ra in range(-180, 181, 60)]
    lines += [_polyline(_hammer(along, np.full(121, float(dec)))) for dec in range(-60, 61, 30)]
    words = []
    for ra in range(-120, 121, 60):
        x, y = _hammer(np.array([float(ra)]), np.zeros(1))[0]
        words.append(f'<text x="{x + 4:.1f}" y="{y - 4:.1f}">{_hours(ra)}</text>')
    box = f"{-_WIDE / 2 - 4:.0f} {-_HIGH / 2 - 4:.0f} {_WIDE + 8:.0f} {_HIGH + 8:.0f}"
    drawing = f'<g class="cells">{"".join(parts)}</g><path class="grid" d="{"".join(lines)}"/>'
    return (
        f'<svg class="sky-map" viewBox="{box}" role="img" aria-label="{escape(label)}">'
        f"{drawing}{''.join(words)}</svg>"
    ), most


def _hammer(ra_deg: Array, dec_deg: Array) -> Array:
    """Hammer's equal-area projection; right ascensions -180 to 180."""
    half, dec = np.radians(ra_deg) / 2, np.radians(dec_deg)
    size = np.sqrt(1 + np.cos(dec) * np.cos(half))
    x, y = 2 * np.cos(dec) * np.sin(half) / size, np.sin(dec) / size
    return np.column_stack([-x * _WIDE / 4, -y * _HIGH / 2])
