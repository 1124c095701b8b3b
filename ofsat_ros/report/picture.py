# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pictures of what was found: the last step, for people.

`annotate` draws one frame; the detector node publishes it, the recorder keeps some of them.
`Tails` remembers where tracks were, to be drawn behind them.  `summary` says in a line what there
is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from itertools import pairwise, product

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.tracking import COASTING

# BGR
_STAR, _RSO, _COASTING = (255, 150, 60), (70, 70, 255), (60, 220, 250)
_TEXT = (235, 235, 235)
# The oldest end of a tail; the newest has its track's colour.
_OLD = (70, 50, 130)
# Points are drawn to a sixteenth of a pixel (cv2's fixed-point drawing).
_SHIFT = 4
_SHORTEST_SIDE = 480
# Of a larger picture a screen shows less than every pixel: lines and letters grow with it.
_SHORTEST_SIDE_OF_PEN = 1000
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LETTERS = 0.42
# px; half the side of the box around an RSO, beyond half its streak.
_BOX_MARGIN_PX = 8
# Part of a side that the corner of an open box is long.
_CORNER = 0.3
# Frames whose places make a tail.
_TAIL_FRAMES = 30
# px; side of a cell of the background under the picture, and distance of the pixels it is made of.
_CELL_PX, _SAMPLE_PX = 64, 8
# Steps of the stretch per sigma of the smoothed noise: 16 bits reach to where white begins.
_STEPS = 64
# Per DN: with more, the brightest DN of 16 bits would overflow the 32 bits of cv2's rounding.
_MOST_STEPS = 2.0**14


class Tails:
    """Where each track was in the last frames, on the sensor.

    Parameters
    ----------
    frames : int
        So many are remembered.
    """

    def __init__(self, frames: int = _TAIL_FRAMES) -> None:
        self._frames: deque[dict[int, tuple[float, float]]] = deque(maxlen=frames)

    def add(self, result: FrameResult) -> None:
        """Take note of a frame's tracks."""
        if result.reset:
            self._frames.clear()
        columns = (result.tracks[name].tolist() for name in ("track_id", "x", "y"))
        self._frames.append({number: (x, y) for number, x, y in zip(*columns, strict=True)})

    def places(self) -> dict[int, NDArray[np.float64]]:
        """Return where the tracks of the last frame were, by id: (N, 2) px, the oldest first."""
        last = self._frames[-1] if self._frames else {}
        return {one: np.array([f[one] for f in self._frames if one in f]) for one in last}


def annotate(
    image: NDArray[np.generic],
    result: FrameResult,
    scale: float = 5.0,
    tails: Mapping[int, NDArray[np.float64]] | None = None,
    footer: str = "",
) -> NDArray[np.uint8]:
    """Draw what was found over the image.

    Stars' flow in blue; each confirmed RSO in a red box with its flow, id, speed and SNR, and a
    tail of where its track was; of a candidate's box only the corners, and no id; a yellow box
    where a coasting track is expected.  A line on top says how many there are, or why there is
    none.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
        The image, DN.
    result : FrameResult
        What it gave.
    scale : float
        Length of a drawn vector, in frames of motion.
    tails : mapping of int to (N, 2) float, optional
        Places of each track in this frame and those before, the oldest first, px: `Tails.places`.
    footer : str
        A line at the bottom.

    Returns
    -------
    (h, w, 3) uint8
        The picture, BGR; as large as the image, or an integer multiple if that is small.
    """
    zoom = max(1, -(-_SHORTEST_SIDE // min(image.shape)))
    gray = cv2.resize(
        _stretch(image, result), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST
    )
    canvas = _Canvas(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), zoom)
    flow, stars = result.flow, result.star_rows
    canvas.vectors(flow.position[stars], flow.displacement[stars] * scale, _STAR)
    coasting = result.tracks[result.tracks["status"] == COASTING]
    for track_id, places in (tails or {}).items():
        canvas.tail(places, _COASTING if track_id in coasting["track_id"] else _RSO)
    for rso in result.detections:
        _draw_rso(canvas, rso, result.dt_s * scale)
    for track in coasting:
        canvas.box(track, _COASTING, True, f"#{track['track_id']} coasting")
    canvas.write(_caption(result), 6, 16, _TEXT)
    if footer:
        canvas.write(footer, 6, canvas.height - 8, _TEXT)
    return canvas.picture


def summary(result: FrameResult) -> str:
    """Say how many RSOs a frame shows, or why there is none."""
    if result.reason:
        return result.reason
    confirmed = int(np.count_nonzero(result.detections["status"] == CONFIRMED))
    candidates = len(result.detections) - confirmed
    coasting = int(np.count_nonzero(result.tracks["status"] == COASTING))
    words = f"{confirmed} RSO{'s' * (confirmed != 1)}" if confirmed else "no confirmed RSO"
    if candidates:
        words += f", {candidates} candidate{'s' * (candidates != 1)}"
    if coasting:
        words += f", {coasting} coasting"
    return words


def _stretch(image: NDArray[np.generic], result: FrameResult) -> NDArray[np.uint8]:
    """8 bits that show faint stars: asinh over the local background, in units of its noise."""
    noise = result.noise if np.isfinite(result.noise) and result.noise > 0 else 1.0
    steps = min(_STEPS / noise, _MOST_STEPS)
    background = _background(image)
    if image.dtype.kind == "u":
        return _SHOWN[cv2.addWeighted(image, steps, background, -steps, 0, dtype=cv2.CV_16U)]
    over = cv2.addWeighted(image, steps, background, -steps, 0, dtype=cv2.CV_32F)
    # What is missing (NaN) is shown as black as what is under the background.
    steps_over = np.fmin(np.fmax(np.rint(over), 0), len(_SHOWN) - 1)
    return _SHOWN[steps_over.astype(np.uint16)]


def _shown() -> NDArray[np.uint8]:
    """Grey of each step over the background."""
    # The smoothed noise is about a third of the pixel noise; 12 of it are some four of those.
    sigmas = np.arange(2**16, dtype=np.float32) / (12 * _STEPS)
    return np.minimum(np.arcsinh(sigmas) * 55 + 18, 255).astype(np.uint8)


_SHOWN = _shown()


def _background(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Medians of cells, smooth between them: good enough to look at."""
    height, width = image.shape
    per_cell = _CELL_PX // _SAMPLE_PX
    samples = image[::_SAMPLE_PX, ::_SAMPLE_PX].astype(np.float32)
    known = np.isfinite(samples)
    samples[~known] = np.median(samples[known]) if known.any() else 0
    rows, columns = (-(-length // per_cell) for length in samples.shape)
    short = (rows * per_cell - samples.shape[0], columns * per_cell - samples.shape[1])
    whole = np.pad(samples, [(0, short[0]), (0, short[1])], mode="symmetric")
    medians = np.median(whole.reshape(rows, per_cell, columns, per_cell), axis=(1, 3))
    smooth = cv2.resize(medians, (columns * _CELL_PX, rows * _CELL_PX))
    return smooth[:height, :width]


class _Canvas:
    """A picture to draw on, in pixels of the image.

    Parameters
    ----------
    picture : (h, w, 3) uint8
        What is drawn on, BGR.
    zoom : int
        Its pixels per pixel of the image.
    """

    def __init__(self, picture: NDArray[np.uint8], zoom: int) -> None:
        self.picture = picture
        self.height, self._width = picture.shape[:2]
        self._zoom = zoom
        self._pen = max(1, round(min(picture.shape[:2]) / _SHORTEST_SIDE_OF_PEN))

    def vectors(
        self,
        origins: NDArray[np.float64],
        vectors: NDArray[np.float64],
        colour: tuple[int, int, int],
    ) -> None:
        """Lines from objects to where they go, and a dot on each so that no motion shows, too."""
        starts, ends = self._fixed(origins).tolist(), self._fixed(origins + vectors).tolist()
        for start, end in zip(starts, ends, strict=True):
            self._line(start, end, colour)
            radius = (2 * self._pen) << _SHIFT
            cv2.circle(self.picture, start, radius, colour, self._pen, cv2.LINE_AA, _SHIFT)

    def tail(self, places: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
        """A line through the places, the brighter the newer."""
        points = self._fixed(places).tolist()
        for number, (start, end) in enumerate(pairwise(points), 1):
            share = number / len(points)
            mixed = share * np.array(colour) + (1 - share) * np.array(_OLD)
            self._line(start, end, tuple(mixed.tolist()))

    def box(self, row: np.void, colour: tuple[int, int, int], closed: bool, label: str) -> None:
        """A square around a place, or only its corners, and a text to the right of it."""
        centre = np.array([row["x"], row["y"]])
        half = self._pen * _BOX_MARGIN_PX + np.nan_to_num(row["length"]) / 2
        start, end = (self._fixed(centre + way).tolist() for way in (-half, half))
        bit = round(_CORNER * (end[0] - start[0]))
        corners = product((start, end), repeat=2)
        if closed:
            cv2.rectangle(self.picture, start, end, colour, self._pen, cv2.LINE_AA, _SHIFT)
        else:
            for (x, _), (_, y) in corners:
                right = x + (bit if x == start[0] else -bit)
                down = y + (bit if y == start[1] else -bit)
                self._line((x, y), (right, y), colour)
                self._line((x, y), (x, down), colour)
        self.write(label, (end[0] >> _SHIFT) + 4, (start[1] >> _SHIFT) + 8 * self._pen, colour)

    def write(self, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
        """Text that stays inside the picture and readable on bright ground."""
        size, pen = _LETTERS * self._pen, self._pen
        (width, height), _ = cv2.getTextSize(text, _FONT, size, pen)
        x = max(2, min(x, self._width - width - 4))
        y = max(height + 2, min(y, self.height - 4 * pen))
        # Not a thicker text for the rim: newer OpenCV makes that longer, too.
        for right, down in product((-pen, pen), repeat=2):
            self._put(text, x + right, y + down, (0, 0, 0))
        self._put(text, x, y, colour)

    def _put(self, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
        size = _LETTERS * self._pen
        cv2.putText(self.picture, text, (x, y), _FONT, size, colour, self._pen, cv2.LINE_AA)

    def _line(self, start: tuple[int, int], end: tuple[int, int], colour: tuple) -> None:
        cv2.line(self.picture, start, end, colour, self._pen, cv2.LINE_AA, _SHIFT)

    def _fixed(self, xy: NDArray[np.float64]) -> NDArray[np.int_]:
        """Points of the image in the picture's fixed-point pixels."""
        return np.rint(((xy + 0.5) * self._zoom - 0.5) * (1 << _SHIFT)).astype(int)


def _draw_rso(canvas: _Canvas, rso: np.void, seconds: float) -> None:
    confirmed = rso["status"] == CONFIRMED
    velocity = np.array([rso["vx"], rso["vy"]])
    origin = np.array([rso["x"], rso["y"]])
    canvas.vectors(origin[None], velocity[None] * seconds, _RSO)
    name = f"#{rso['track_id']} " if confirmed else ""
    label = f"{name}{np.hypot(*velocity):.2f} px/s SNR {rso['snr']:.0f}"
    canvas.box(rso, _RSO, confirmed, label)


def _caption(result: FrameResult) -> str:
    found = summary(result)
    if result.reason:
        return f"frame {result.frame}: no RSO: {found}"
    line = f"frame {result.frame}: {found}"
    if result.star_field is not None:
        dx, dy = result.star_field.displacement
        line += f"; {result.star_field.star_count} stars move ({dx:+.2f}, {dy:+.2f}) px"
    return line
