# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a folder of results tells: its tables, and each track's path about a smooth motion.

The first step of a report: everything after it, pictures, charts and words, starts from
`Findings`.  Only files are read here; the recording itself is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.results import (
    DETECTION_COLUMNS,
    DETECTIONS,
    STAR_FIELD,
    STAR_FIELD_COLUMNS,
    read_run,
    read_table,
)

Array = NDArray[np.float64]

# A smooth motion is a polynomial of time; so many detections allow each degree.
_LEAST_FOR_DEGREE = (1, 3, 8, 20)

# What is slower on the sensor than this part of its motion against the stars stands still there.
_FOLLOWED = 0.15


@dataclass(frozen=True)
class Smooth:
    """A track's path about the smoothest motion that explains it.

    Attributes
    ----------
    against : str
        ``stars`` or ``sensor``: where the motion is smooth.  A mount that jitters moves what it
        follows over the sensor; an RSO that it follows well stands still there.
    residuals : (K, 2) float64
        Detections minus that motion, px of the sensor; NaN if there are too few detections.
    rms : float
        Of each axis, px, corrected for what was fitted.
    """

    against: str
    residuals: Array
    rms: float


@dataclass(frozen=True)
class Track:
    """One confirmed track: its detections, and where they lie on the sky.

    Attributes
    ----------
    number : int
        The track's id.
    rows : (K,) structured array
        Its detections, with the columns of ``detections.csv``.
    sky : (K, 2) float64
        Their places among the stars, px of the sky (see `Findings.to_sky`).
    """

    number: int
    rows: NDArray[np.void]
    sky: Array
    _turns: Array

    @property
    def places(self) -> Array:
        """Places in the image, (K, 2) px."""
        return np.column_stack([self.rows["x_px"], self.rows["y_px"]])

    @property
    def seconds(self) -> Array:
        """Times of the detections after the first, (K,) s."""
        return (self.rows["stamp_ns"] - self.rows["stamp_ns"][0]) / 1e9

    @property
    def snr(self) -> float:
        """Median SNR."""
        return float(np.median(self.rows["snr"]))

    @property
    def flux(self) -> float:
        """Median flux, DN."""
        return float(np.median(self.rows["flux"]))

    @property
    def speed(self) -> float:
        """Median speed against the stars, px/s."""
        return float(np.median(np.hypot(self.rows["rel_vx_px_s"], self.rows["rel_vy_px_s"])))

    @property
    def sigma(self) -> Array:
        """Stated std of each detection's place, of an axis, (K,) px."""
        return np.sqrt((self.rows["sigma_x_px"] ** 2 + self.rows["sigma_y_px"] ** 2) / 2)

    @property
    def is_followed(self) -> bool:
        """Whether it nearly stands still on the sensor while the stars move."""
        own = np.median(np.hypot(self.rows["vx_px_s"], self.rows["vy_px_s"]))
        return bool(own < _FOLLOWED * self.speed)

    @cached_property
    def smooth(self) -> Smooth:
        """The path about a smooth motion, against the stars or the sensor as is smoother."""
        moves = [
            Smooth("sensor", *_about_polynomial(self.seconds, self.places)),
            Smooth("stars", *_about_polynomial(self.seconds, self.sky)),
        ]
        best = min(moves, key=lambda move: np.nan_to_num(move.rms, nan=np.inf))
        if best.against == "stars":
            back = np.einsum("kij,kj->ki", self._turns, best.residuals)
            best = Smooth("stars", back, best.rms)
        return best

    @cached_property
    def arcsec_per_s(self) -> float:
        """Mean angular speed on the sky, arcsec/s; NaN without directions."""
        ra, dec = np.radians(self.rows["ra_deg"]), np.radians(self.rows["dec_deg"])
        known = np.flatnonzero(np.isfinite(ra + dec))
        if len(known) < 2 or self.seconds[known[-1]] == self.seconds[known[0]]:
            return float("nan")
        at = np.column_stack([np.cos(ra) * np.cos(dec), np.sin(ra) * np.cos(dec), np.sin(dec)])
        first, last = at[known[0]], at[known[-1]]
        angle = np.arctan2(np.linalg.norm(np.cross(first, last)), first @ last)
        return float(np.degrees(angle) * 3600 / (self.seconds[known[-1]] - self.seconds[known[0]]))


@dataclass(frozen=True)
class Findings:
    """The results of one run.

    Attributes
    ----------
    folder : Path
    run : dict
        What ``run.json`` holds.
    detections, frames : structured arrays
        Rows of ``detections.csv`` and ``star_field.csv``; the latter has one for each frame.
    to_sky : (N, 3, 3) float64
        For each frame, the matrix from its pixels to the sky: the pixels that the stars have in
        the first frame of its stretch.
    stretch : (N,) int
        Number of the stretch that a frame is in: stars of one cannot be held against another's.
    tracks : list of Track
        Those that say most first.
    """

    folder: Path
    run: dict[str, Any]
    detections: NDArray[np.void]
    frames: NDArray[np.void]
    to_sky: Array
    stretch: NDArray[np.int_]
    tracks: list[Track]

    @cached_property
    def row_of(self) -> dict[int, int]:
        """The row in `frames` of each frame's number."""
        return {int(number): row for row, number in enumerate(self.frames["frame"])}

    @cached_property
    def main_stretch(self) -> NDArray[np.intp]:
        """Rows of the longest stretch of frames; empty without frames."""
        if not len(self.frames):
            return np.zeros(0, np.intp)
        return np.flatnonzero(self.stretch == np.bincount(self.stretch).argmax())

    def is_in_main_stretch(self, track: Track) -> bool:
        """Whether a track, which no break outlives, lies on the same sky as `main_stretch`."""
        last = self.row_of[int(track.rows["frame"][-1])]
        return bool(self.stretch[last] == self.stretch[self.main_stretch[0]])

    @cached_property
    def step_s(self) -> float:
        """Usual time between two frames, s; 1 if there are no two."""
        steps = self.frames["dt_s"][self.frames["dt_s"] > 0]
        return float(np.median(steps)) if len(steps) else 1.0

    @property
    def seconds(self) -> Array:
        """Times of the frames after the first, (N,) s."""
        stamps = self.frames["stamp_ns"]
        return (stamps - stamps[:1]) / 1e9


def read_findings(folder: Path) -> Findings:
    """Read a folder that ``ofsat process`` has made; also one that it was stopped over.

    Raises
    ------
    ResultError
        If it holds no results, or a file is not what it should be.
    OSError
        If a file cannot be read.
    """
    run = read_run(folder)
    for count in ("frames", "width", "height"):
        run[count] = max(run[count] or 0, 0)
    detections = read_table(folder / DETECTIONS, DETECTION_COLUMNS)
    frames = read_table(folder / STAR_FIELD, STAR_FIELD_COLUMNS)
    centre = (run["width"] - 1) / 2, (run["height"] - 1) / 2
    to_sky, stretch = _follow_stars(frames, centre)
    rows = {int(number): row for row, number in enumerate(frames["frame"])}
    tracks = []
    for number in np.unique(detections["track_id"][detections["track_id"] > 0]):
        own = detections[detections["track_id"] == number]
        own = own[np.isin(own["frame"], frames["frame"])]
        if len(own):
            tracks.append(_track(int(number), own, to_sky[[rows[int(f)] for f in own["frame"]]]))
    tracks.sort(key=lambda track: -track.snr * np.sqrt(len(track.rows)))
    return Findings(folder, run, detections, frames, to_sky, stretch, tracks)


def _track(number: int, rows: NDArray[np.void], to_sky: Array) -> Track:
    places = np.column_stack([rows["x_px"], rows["y_px"], np.ones(len(rows))])
    sky = np.einsum("kij,kj->ki", to_sky, places)[:, :2]
    turns = np.linalg.inv(to_sky)[:, :2, :2].astype(np.float64)
    return Track(number, rows, sky, turns)


def _follow_stars(
    frames: NDArray[np.void], centre: tuple[float, float]
) -> tuple[Array, NDArray[np.int_]]:
    """Chain the star field's motions to where each frame lies on the sky.

    Where no motion was found, the last one is taken to go on.
    """
    to_sky, stretch = np.zeros((len(frames), 3, 3)), np.zeros(len(frames), int)
    motion = None
    for i, row in enumerate(frames):
        if not i or np.isnan(row["dt_s"]):  # compared with no other frame
            to_sky[i], motion = np.eye(3), None
            stretch[i] = stretch[i - 1] + 1 if i else 0
            continue
        if np.isfinite(row["dx_px"]):
            motion = row
        back = np.eye(3) if motion is None else _to_previous(motion, row["dt_s"], centre)
        to_sky[i], stretch[i] = to_sky[i - 1] @ back, stretch[i - 1]
    return to_sky, stretch


def _to_previous(motion: np.void, dt_s: float, centre: tuple[float, float]) -> Array:
    """Matrix from pixels of a frame to those of the frame before (see StarFieldMotion)."""
    times = dt_s / motion["dt_s"]
    s, r = motion["scale"] * times, np.radians(motion["rotation_deg"]) * times
    matrix, part = np.eye(3), np.array([[s, -r], [r, s]])
    matrix[:2, :2] -= part
    shift = np.array([motion["dx_px"], motion["dy_px"]]) * times
    matrix[:2, 2] = part @ np.array(centre) - shift
    return matrix


def _about_polynomial(seconds: Array, places: Array) -> tuple[Array, float]:
    """Residuals about a polynomial of time, (K, 2), and their rms of each axis."""
    count = len(seconds)
    degree = sum(count >= least for least in _LEAST_FOR_DEGREE) - 1
    if degree < 1:
        return np.full((count, 2), np.nan), float("nan")
    times = seconds / max(seconds[-1], 1e-9) * 2 - 1
    design = np.polynomial.legendre.legvander(times, degree)
    fitted, *_ = np.linalg.lstsq(design, places, rcond=None)
    residuals = places - design @ fitted
    freedom = max(count - degree - 1, 1)
    return residuals, float(np.sqrt((residuals**2).sum() / (2 * freedom)))
