# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pictures out of the recording, in one pass over it: the deep sky, and cut-outs of each track.

`Sky` lays the frames on each other, on the stars and on the sensor; `CutOuts` keeps what lies
around each track's detections.  Both take one frame after the other and hold no recording.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.report.findings import Findings, Track

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
_Image = NDArray[np.float32]

# px; the longest side of a frame in a picture, and of a picture, and its area.
_FRAME_SIDE, _LONGEST_SIDE, _LARGEST_AREA = 1200, 4800, 3_000_000
# Frames that are laid on the stars; more would cost time and show little more.
_STACKED_FRAMES = 200
# Frames, evenly chosen, whose median shows what stands still on the sensor.
_SENSOR_FRAMES = 25
# Of the first frames, as many show the sensor's pattern, if the stars have moved so far, px.
_PATTERN_FRAMES, _PATTERN_MOTION_PX = 15, 12.0
# Part of those frames in which a place is darker than the pattern: stars pass over it in others.
_PATTERN_SHARE = 0.2
# A picture of the sensor says something of its own if the stars have moved so far, px.
_SENSOR_MOTION_PX = 4.0
# px; cells over which the sky's brightness is taken to be even.
_EVEN_PX = 32
# Cut-outs shown of a track, and px from its middle to its sides.
_SHOWN, _LEAST_HALF, _LARGEST_HALF = 16, 16, 48
# What a picture's darkest and brightest pixels are at least, in sigmas of its background.
_DARKEST, _BRIGHTEST = -1.5, 12.0
# Sigmas up to which a picture is linear.
_KNEE = 4.0
# Sigmas; darker than anything is.
_DARK = -1e30


@dataclass(frozen=True)
class View:
    """One picture of the sky.

    Attributes
    ----------
    name, meaning : str
        What it is called, and what it shows.
    picture : (h, w) uint8
    on_stars : bool
        Whether the stars stand still in it, or the sensor.
    from_place : (2, 3) float64
        From places on the sky, or in the image, to the picture's pixels.
    """

    name: str
    meaning: str
    picture: Picture
    on_stars: bool
    from_place: Array

    def paths(self, track: Track) -> Array:
        """Where a track's detections lie in the picture, (K, 2) px."""
        places = track.sky if self.on_stars else track.places
        return places @ self.from_place[:, :2].T + self.from_place[:, 2]


class Sky:
    """Frames laid on each other; `add` takes each, in their order."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        run, rows = findings.run, findings.main_stretch
        self._size = run["width"], run["height"]
        self._scale = _scale(*self._size)
        # Large frames are made small at once: all that is kept of them, memory has to hold.
        self._reduced, self._enlarged = min(self._scale, 1.0), max(self._scale, 1.0)
        moved = findings.to_sky[rows][:, :2] @ np.array(
            [(self._size[0] - 1) / 2, (self._size[1] - 1) / 2, 1.0]
        )
        span = np.ptp(moved, axis=0).max() if len(rows) else 0.0
        self._rows = set(_evenly(rows, _STACKED_FRAMES).tolist())
        self._first_rows = set(rows[:_PATTERN_FRAMES].tolist())
        early = moved[:_PATTERN_FRAMES]
        self._pattern_shows = len(early) > 2 and np.ptp(early, axis=0).max() > _PATTERN_MOTION_PX
        sensor_rows = _evenly(rows, _SENSOR_FRAMES) if span > _SENSOR_MOTION_PX else rows[:0]
        self._sensor_rows = set(sensor_rows.tolist())
        self._canvas = _Canvas(findings.to_sky[rows], self._size, self._scale)
        self._first: list[tuple[int, _Image]] = []
        self._pattern: _Image | None = None
        self._sensor: list[_Image] = []
        self._span = float(span)

    def add(self, row: int, image: NDArray[np.generic]) -> None:
        """Take one frame, that of a row of the findings' frames."""
        if row in self._sensor_rows or row in self._rows or row in self._first_rows:
            values = _scaled(self._in_sigmas(row, image), self._reduced)
            if row in self._sensor_rows:
                self._sensor.append(_scaled(values, self._enlarged))
            if row in self._first_rows:
                self._first.append((row, values))
            elif row in self._rows:
                self._lay(row, values)

    def views(self) -> list[View]:
        """Return the pictures; those that say most first."""
        self._lay_first()
        views, frames, place = [], self._canvas.frames, self._canvas.from_sky
        if frames == 1:
            single, _ = self._canvas.mean_and_maximum()
            about = "a single frame: there is no other to lay on it"
            views.append(View("Frame", about, _stretched(_flat(single)), True, place))
        elif frames:
            # The mean is deep, the maximum shows what was in a place in one frame only.
            mean, brightest = self._canvas.mean_and_maximum()
            about = f"the mean of {frames} frames, laid on the stars: what is fixed on the sky"
            views.append(View("Deep sky", about, _stretched(_flat(mean)), True, place))
            about = (
                f"the brightest value that each place of the sky has shown in {frames} frames:"
                " what moves leaves a trail"
            )
            views.append(View("Movers", about, _stretched(_flat(brightest)), True, place))
        if self._sensor:
            stack = np.stack(self._sensor)
            median = _flat(np.median(stack, axis=0, overwrite_input=True).astype(np.float32))
            about = (
                f"the median of {len(stack)} frames as the sensor sees them: what the mount"
                " follows stands still, stars that move fade"
            )
            place = np.hstack([np.eye(2) * self._scale, np.full((2, 1), (self._scale - 1) / 2)])
            views.append(View("Sensor", about, _stretched(median), False, place))
        followed = [track.is_followed for track in self._findings.tracks]
        # Where RSOs stand still on the sensor, or the sky is a long strip, its picture says most.
        if self._span > max(self._size) or sum(followed) > len(followed) / 2:
            first = "Sensor"
        else:
            first = "Movers" if followed else "Deep sky"
        views.sort(key=lambda view: view.name != first)
        return views

    def _in_sigmas(self, row: int, image: NDArray[np.generic]) -> _Image:
        frame = self._findings.frames[row]
        level, noise = frame["background"], frame["noise"]
        level = level if np.isfinite(level) else np.median(image.astype(np.float32))
        per_dn = 1 / noise if np.isfinite(noise) and noise > 0 else 1.0
        values = cv2.addWeighted(image, per_dn, image, 0, -level * per_dn, dtype=cv2.CV_32F)
        if image.dtype.kind == "f":  # what is missing is as dark as the sky
            np.nan_to_num(values, copy=False, nan=0, posinf=0, neginf=0)
        return np.asarray(values)

    def _lay(self, row: int, values: _Image) -> None:
        self._lay_first()
        if self._pattern is not None:
            values = values - self._pattern
        self._canvas.lay(_scaled(values, self._enlarged), self._findings.to_sky[row])

    def _lay_first(self) -> None:
        """Learn the sensor's pattern from the first frames, and lay them, too."""
        first, self._first = self._first, []
        if not first:
            return
        stack = np.stack([values for _, values in first])
        middle, darker = len(stack) // 2, int(_PATTERN_SHARE * len(stack))
        stack.partition([darker, middle], axis=0)
        even = _even(stack[middle])
        if self._pattern_shows:
            dark = stack[darker]
            # What the mount follows stands still, too, and is no pattern.
            shown = np.isin(self._findings.detections["frame"], self._numbers(first))
            followed = np.zeros(dark.shape, np.uint8)
            for found in self._findings.detections[shown]:
                at = [round(found[name] * self._reduced) for name in ("x_px", "y_px")]
                half = (6 + np.nan_to_num(found["length_px"]) / 2) * self._reduced
                cv2.circle(followed, at, round(half), 1, -1)
            dark = np.where(followed, _even(dark), dark)
            self._pattern = dark
        else:
            self._pattern = even
        for row, values in first:
            if row in self._rows:
                self._lay(row, values)

    def _numbers(self, first: list[tuple[int, _Image]]) -> NDArray[np.int_]:
        return np.asarray(self._findings.frames["frame"][[row for row, _ in first]])


class _Canvas:
    """The sky that the frames cover, and what they add up to there."""

    def __init__(self, to_sky: Array, size: tuple[int, int], scale: float) -> None:
        width, height = size
        corners = np.array([(0, 0, 1), (width, 0, 1), (0, height, 1), (width, height, 1)]) - 0.5
        corners[:, 2] = 1
        spread = (to_sky[:, :2] @ corners.T).transpose(0, 2, 1).reshape(-1, 2)
        low, high = (spread.min(0), spread.max(0)) if len(spread) else (np.zeros(2), np.ones(2))
        wide, tall = (high - low) * scale
        less = min(
            1, _LONGEST_SIDE / max(wide, tall), float(np.sqrt(_LARGEST_AREA / (wide * tall)))
        )
        self._scale, zoom = scale, scale * less
        offset = -(low + 0.5) * zoom - 0.5 + 0.5 * zoom
        self.from_sky = np.column_stack([np.eye(2) * zoom, offset + 0.0])
        self._shape = max(round(tall * less), 1), max(round(wide * less), 1)
        self._sum = np.zeros(self._shape, np.float32)
        self._count = np.zeros(self._shape, np.float32)
        self._maximum = np.full(self._shape, _DARK, np.float32)
        self.frames = 0

    def lay(self, image: _Image, to_sky: Array) -> None:
        scale = self._scale
        whole = np.vstack([self.from_sky, (0, 0, 1)])
        unscaled = np.array([(1 / scale, 0, 0.5 / scale - 0.5), (0, 1 / scale, 0.5 / scale - 0.5)])
        matrix = whole @ to_sky @ np.vstack([unscaled, (0, 0, 1)])
        height, width = image.shape
        corners = (
            matrix[:2] @ np.array([(0, 0, 1), (width, 0, 1), (0, height, 1), (width, height, 1)]).T
        )
        low = np.clip(np.floor(corners.min(1)).astype(int) - 1, 0, None)
        high = np.minimum(np.ceil(corners.max(1)).astype(int) + 2, self._shape[::-1])
        if (high <= low).any():
            return
        matrix[:2, 2] -= low
        laid = cv2.warpAffine(
            image, matrix[:2], tuple((high - low).tolist()), borderValue=float("nan")
        )
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        known = (laid == laid).view(np.uint8)
        self._count[part] += known
        cv2.patchNaNs(laid, _DARK)
        np.maximum(self._maximum[part], laid, out=self._maximum[part])
        laid *= known
        self._sum[part] += laid
        self.frames += 1

    def mean_and_maximum(self) -> tuple[_Image, _Image]:
        unknown = self._count == 0
        mean = np.asarray(self._sum / np.maximum(self._count, 1), np.float32)
        maximum = self._maximum.copy()
        mean[unknown] = maximum[unknown] = np.nan
        return mean, maximum


@dataclass
class _Cuts:
    """What is kept of one track."""

    track: Track
    half: int
    shown: set[int]
    sum: _Image
    known: _Image
    cuts: list[tuple[int, _Image]] = field(default_factory=list)
    count: int = 0


@dataclass(frozen=True)
class Gallery:
    """Cut-outs of one track: some of its frames, by their numbers, and the mean of all.

    Attributes
    ----------
    cuts : list of (frame, (n, n) uint8)
    mean : (n, n) uint8
    count : int
        Frames in the mean.
    """

    cuts: list[tuple[int, Picture]]
    mean: Picture
    count: int


class CutOuts:
    """What lies around the detections of some tracks; `add` takes each frame, in their order."""

    def __init__(self, tracks: list[Track]) -> None:
        self._tracks: dict[int, _Cuts] = {}
        self._in_frame: dict[int, list[tuple[_Cuts, float, float]]] = {}
        for track in tracks:
            length = float(np.nan_to_num(np.median(track.rows["length_px"])))
            half = int(np.clip(round(_LEAST_HALF + 0.75 * length), _LEAST_HALF, _LARGEST_HALF))
            shown = set(_evenly(track.rows["frame"], _SHOWN).tolist())
            none = np.zeros((2 * half + 1,) * 2, np.float32)
            cuts = _Cuts(track, half, shown, none, none.copy())
            self._tracks[track.number] = cuts
            for row in track.rows:
                places = self._in_frame.setdefault(int(row["frame"]), [])
                places.append((cuts, float(row["x_px"]), float(row["y_px"])))

    def add(self, number: int, image: NDArray[np.generic]) -> None:
        """Take the frame of a number."""
        for of, x, y in self._in_frame.get(number, ()):
            cut = _cut(image, x, y, of.half)
            known = np.isfinite(cut)
            if not known.any():
                continue
            of.sum += np.where(known, cut, 0)
            of.known += known
            of.count += 1
            if number in of.shown:
                of.cuts.append((number, cut))

    def galleries(self) -> dict[int, Gallery]:
        """Return those of each track, by its number."""
        return {number: _gallery(cuts) for number, cuts in self._tracks.items() if cuts.count}


def _cut(image: NDArray[np.generic], x: float, y: float, half: int) -> _Image:
    """What lies around a place, to a part of a pixel; NaN outside the image."""
    side = 2 * half + 1
    # Only as much as is cut, since a whole image costs time to convert.
    left, top = int(x) - half - 2, int(y) - half - 2
    begin = max(left, 0), max(top, 0)
    near = image[begin[1] : top + side + 4, begin[0] : left + side + 4].astype(np.float32)
    if not near.size:
        return np.full((side, side), np.nan, np.float32)
    x, y = x - begin[0], y - begin[1]
    if near.shape == (side + 4, side + 4):  # quicker, but repeats the image's edge
        return np.asarray(cv2.getRectSubPix(near, (side, side), (x, y)))
    shift = np.array([(1, 0, half - x), (0, 1, half - y)])
    return np.asarray(cv2.warpAffine(near, shift, (side, side), borderValue=float("nan")))


def _gallery(of: _Cuts) -> Gallery:
    """One stretch for all frames of a track, so that they can be compared."""
    mean = np.where(of.known > 0, of.sum / np.maximum(of.known, 1), np.float32(np.nan))
    cuts = [(number, cut - np.float32(np.nanmedian(cut))) for number, cut in of.cuts]
    values = np.concatenate([cut.ravel() for _, cut in cuts])
    noise = _sigma(values[np.isfinite(values)])
    middle = np.s_[of.half - 2 : of.half + 3, of.half - 2 : of.half + 3]
    bright = float(np.median([np.nan_to_num(cut[middle]).max() for _, cut in cuts]))
    limits = _DARKEST * noise, max(bright, 6 * noise), _KNEE * noise
    return Gallery(
        [(number, _asinh(cut, *limits)) for number, cut in cuts], _stretched(mean), of.count
    )


def _stretched(values: _Image) -> Picture:
    """8 bits that show faint stars: asinh, in units of the background's noise."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(values.shape, np.uint8)
    sample = values[known]
    level, sigma = float(np.median(sample)), _sigma(sample)
    bright = max(float(np.percentile(sample, 99.9)) - level, _BRIGHTEST * sigma)
    shown = _asinh(values - np.float32(level), _DARKEST * sigma, bright, _KNEE * sigma)
    shown[~known] = 0
    return shown


def _asinh(values: _Image, dark: float, bright: float, knee: float) -> Picture:
    top = np.arcsinh((bright - dark) / knee)
    with np.errstate(invalid="ignore"):
        shown = np.arcsinh((values - np.float32(dark)) / np.float32(knee)) * np.float32(255 / top)
    return np.clip(np.nan_to_num(shown), 0, 255).astype(np.uint8)


def _sigma(values: NDArray[np.float32]) -> float:
    """Robust std; of a sky that is all the same, 1."""
    values = values[:: max(1, values.size // 200_000)]
    sigma = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    return sigma if sigma > 0 else float(np.std(values)) or 1.0


def _flat(values: _Image) -> _Image:
    known = np.isfinite(values)
    if not known.any():
        return values
    return values - _even(np.where(known, values, np.median(values[known])).astype(np.float32))


def _even(values: _Image) -> _Image:
    """The brightness of the sky without what is small: medians of cells, and between them."""
    height, width = values.shape
    rows, columns = max(height // _EVEN_PX, 1), max(width // _EVEN_PX, 1)
    cells = cv2.resize(values, (columns * 8, rows * 8), interpolation=cv2.INTER_AREA)
    blocks = cells.reshape(rows, 8, columns, 8).transpose(0, 2, 1, 3).reshape(rows, columns, 64)
    medians = np.median(blocks, axis=2).astype(np.float32)
    if min(medians.shape) >= 3:
        medians = cv2.medianBlur(medians, 3)
    return np.asarray(cv2.resize(medians, (width, height), interpolation=cv2.INTER_CUBIC))


def _scale(width: int, height: int) -> float:
    """How many pixels of a picture a pixel of a frame takes: small frames are shown larger."""
    zoom = _FRAME_SIDE / max(width, height, 1)
    return float(min(int(zoom), 3)) if zoom >= 1 else zoom


def _scaled(values: _Image, scale: float) -> _Image:
    if scale == 1:
        return values
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(values, None, fx=scale, fy=scale, interpolation=how))


def _evenly(values: NDArray[np.int_], count: int) -> NDArray[np.int_]:
    """Return so many of the values at most, first and last among them."""
    if len(values) <= count:
        return values
    return values[np.linspace(0, len(values) - 1, count).round().astype(int)]
