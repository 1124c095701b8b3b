# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Peers of the package for benchmarks/detection.py: what a careful user makes of SExtractor.

Both begin with `sep`, SExtractor's algorithms as a library: background mesh, matched filter,
threshold, deblending, moments.  The field's motion between two frames is the similarity that a
robust fit finds through the matched stars.

- ``sep_two_frames``: what has no star at its place in the frame before, but a source of like
  brightness within reach, is an RSO.
- ``sep_linking``: all frames' sources in the coordinates of the first frame's stars.  What is
  often there at one place is a star; the rest is linked to straight tracks at constant velocity,
  with the whole sequence at hand.

Their settings were chosen from about ten, by their totals over the simulated development
sequences: on these the figures flatter them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import sep
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ofsat_ros.detection import CONFIRMED, DETECTION_DTYPE

Floats = NDArray[np.float64]

_MESH_PX, _THRESHOLD, _MIN_AREA_PX = 64, 3.0, 5
_LEAST_WIDTH = 2.5  # flux over peak; 6 for a PSF of 1 px, 1 for a hot pixel
_VOTERS, _VOTE_REACH_PX, _VOTE_CELL_PX = 80, 160.0, 3.0
# A source is a star's if the field's motion puts one so near, px or sizes of the larger one.
_STAR_PX, _STAR_SIZES = 1.0, 1.5
_REACH_PX, _FLUX_RATIO = 40.0, 2.0  # of one object from frame to frame
_PAIR_SNR = 6.0  # what fainter sources give in two frames is nearly all noise
_STAR_SHARE, _STAR_FRAMES = 0.4, 20  # in this share of so many other frames, a star is seen
_MOST_CANDIDATES = 400  # of a frame, the brightest
_LINK_PX, _LEAST_HITS, _LEAST_SHARE = 1.2, 4, 0.6


@dataclass(frozen=True)
class _Sources:
    """Sources of one frame, the brightest first.

    Positions (N, 2) px; flux, SNR and size (N,), the size being the std along the major axis, px.
    """

    xy: Floats
    size: Floats
    flux: Floats
    snr: Floats


def sep_two_frames(
    images: Sequence[NDArray[np.generic]], stamps_ns: Sequence[int]
) -> list[NDArray[np.void]]:
    """Detect RSOs from each pair of frames.

    Parameters
    ----------
    images : sequence of (H, W) arrays
        The frames, DN.
    stamps_ns : sequence of int
        Their stamps, ns.

    Returns
    -------
    list of (K,) DETECTION_DTYPE
        For each frame; all of them confirmed, without track.
    """
    frames = [_extract(image) for image in images]
    found = [np.zeros(0, DETECTION_DTYPE)]
    for k in range(1, len(frames)):
        before, now = frames[k - 1], frames[k]
        dt_s = (stamps_ns[k] - stamps_ns[k - 1]) / 1e9
        field = _field_motion(before, now)
        expected = _moved(before.xy, field)
        new = _no_star(now.xy, now.size, expected, before.size) & (now.snr > _PAIR_SNR)
        gone = _no_star(expected, before.size, now.xy, now.size) & (before.snr > _PAIR_SNR)
        rows, origins = _pairs(before, now, np.flatnonzero(gone), np.flatnonzero(new))
        displacement = now.xy[rows] - before.xy[origins]
        found.append(_detections(now, rows, displacement / dt_s, np.zeros(len(rows), int)))
    return found


def sep_linking(
    images: Sequence[NDArray[np.generic]], stamps_ns: Sequence[int]
) -> list[NDArray[np.void]]:
    """Detect RSOs by linking over the whole sequence; else as `sep_two_frames`."""
    frames = [_extract(image) for image in images]
    to_first = [np.eye(3)]
    for before, now in pairwise(frames):
        to_first.append(to_first[-1] @ np.linalg.inv(_field_motion(before, now)))
    sky = [_moved(frame.xy, motion) for frame, motion in zip(frames, to_first, strict=True)]
    others = _not_stars(frames, sky, to_first, images[0].shape)
    seconds = (np.array(stamps_ns) - stamps_ns[0]) / 1e9
    tracks = _link(frames, sky, others, seconds)

    found = [[np.zeros(0, DETECTION_DTYPE)] for _ in frames]
    for number, track in enumerate(tracks, 1):
        ks = np.array(sorted(track))
        path = np.array([frames[k].xy[track[k]] for k in ks])
        velocity = np.polyfit(seconds[ks], path, 1)[0]
        for k in ks:
            row = np.array([track[k]])
            found[k].append(_detections(frames[k], row, velocity[None], np.array([number])))
    return [np.concatenate(parts) for parts in found]


def _extract(image: NDArray[np.generic]) -> _Sources:
    data = np.ascontiguousarray(image, dtype=np.float32)
    background = sep.Background(data, bw=_MESH_PX, bh=_MESH_PX)
    data = data - background
    # Without CLEAN, which deletes faint sources near bright ones.
    rows = sep.extract(data, _THRESHOLD, err=background.rms(), minarea=_MIN_AREA_PX, clean=False)
    flux, error, _ = sep.sum_circle(data, rows["x"], rows["y"], 2.5, err=background.rms())
    wide = flux > _LEAST_WIDTH * data[rows["ypeak"], rows["xpeak"]]
    order = np.flatnonzero(wide)[np.argsort(-rows["flux"][wide])]
    xy = np.stack([rows["x"], rows["y"]], axis=1)[order]
    return _Sources(xy, rows["a"][order], rows["flux"][order], (flux / error)[order])


def _field_motion(before: _Sources, now: _Sources) -> Floats:
    """The similarity that takes the stars of one frame to the next, a (3, 3) matrix."""
    shift = _voted_shift(before.xy[:_VOTERS], now.xy[:_VOTERS])
    motion = np.eye(3)
    motion[:2, 2] = shift
    for reach in (5.0, 2.0, 1.5):
        if not len(before.xy) or not len(now.xy):
            break
        distance, index = cKDTree(now.xy).query(_moved(before.xy, motion))
        near = distance < reach
        if np.count_nonzero(near) < 4:
            break
        fitted, _ = cv2.estimateAffinePartial2D(
            before.xy[near], now.xy[index[near]], method=cv2.RANSAC, ransacReprojThreshold=1.0
        )
        if fitted is not None:
            motion = np.vstack([fitted, [0, 0, 1]])
    return motion


def _voted_shift(before: Floats, now: Floats) -> Floats:
    """The displacement that most pairs of bright sources agree on."""
    shifts = (now[None] - before[:, None]).reshape(-1, 2)
    shifts = shifts[np.hypot(*shifts.T) < _VOTE_REACH_PX]
    if not len(shifts):
        return np.zeros(2)
    tree = cKDTree(shifts)
    votes = [len(near) for near in tree.query_ball_point(shifts, _VOTE_CELL_PX)]
    return np.median(
        shifts[tree.query_ball_point(shifts[np.argmax(votes)], _VOTE_CELL_PX)], axis=0
    )


def _moved(xy: Floats, motion: Floats) -> Floats:
    return xy @ motion[:2, :2].T + motion[:2, 2]


def _no_star(xy: Floats, size: Floats, star_xy: Floats, star_size: Floats) -> NDArray[np.bool_]:
    """Whether each source has no star at its place; a piece of a streak lies within the star."""
    if not len(star_xy) or not len(xy):
        return np.ones(len(xy), bool)
    distance, index = cKDTree(star_xy).query(xy, k=min(3, len(star_xy)))
    distance, index = (np.reshape(a, (len(xy), -1)) for a in (distance, index))
    reach = _STAR_SIZES * np.maximum(star_size[index], size[:, None]) - 1
    return np.all(distance > np.maximum(_STAR_PX, reach), axis=1)


def _pairs(
    before: _Sources, now: _Sources, others_before: NDArray[np.intp], others_now: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Nearest neighbours of like brightness among what is no star, one to one."""
    step = now.xy[others_now][:, None] - before.xy[others_before][None]
    distance = np.hypot(step[..., 0], step[..., 1])
    ratio = now.flux[others_now][:, None] / before.flux[others_before][None]
    unlike = np.maximum(ratio, 1 / ratio) > _FLUX_RATIO
    distance[unlike | (distance > _REACH_PX)] = np.inf
    rows, origins = [], []
    while distance.size and np.isfinite(distance.min()):
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        rows.append(others_now[i])
        origins.append(others_before[j])
        distance[i, :] = distance[:, j] = np.inf
    return np.array(rows, int), np.array(origins, int)


def _not_stars(
    frames: list[_Sources],
    sky: list[Floats],
    to_first: list[Floats],
    shape: tuple[int, ...],
) -> list[NDArray[np.intp]]:
    """Rows of each frame that are seldom seen again at their place among the stars."""
    others = []
    sample = np.unique(np.linspace(0, len(sky) - 1, _STAR_FRAMES).astype(int))
    for k, here in enumerate(sky):
        seen, covered = np.zeros(len(here)), np.zeros(len(here))
        for m in sample[sample != k]:
            there = sky[m]
            x, y = _moved(here, np.linalg.inv(to_first[m])).T
            covered += (x >= 2) & (y >= 2) & (x <= shape[1] - 3) & (y <= shape[0] - 3)
            seen += ~_no_star(here, frames[k].size, there, frames[m].size)
        rows = np.flatnonzero(seen < _STAR_SHARE * np.maximum(covered, 1))
        others.append(rows[:_MOST_CANDIDATES])
    return others


def _link(
    frames: list[_Sources], sky: list[Floats], others: list[NDArray[np.intp]], seconds: Floats
) -> list[dict[int, int]]:
    """Straight tracks, the longest first; each is the row of its source by frame."""
    trees = [cKDTree(xy[rows]) for xy, rows in zip(sky, others, strict=True)]
    tracks = []
    for k in range(len(frames) - 1):
        for i in others[k]:
            for j in _successors(frames, sky, others, trees, k, i):
                velocity = (sky[k + 1][j] - sky[k][i]) / (seconds[k + 1] - seconds[k])
                track = _follow(sky, others, trees, seconds, k, sky[k][i], velocity)
                if len(track) >= _LEAST_HITS:
                    tracks.append(track)
    taken: set[tuple[int, int]] = set()
    kept = []
    for track in sorted(tracks, key=len, reverse=True):
        own = set(track.items())
        span = max(track) - min(track) + 1
        if not own & taken and len(own) >= _LEAST_SHARE * span:
            taken |= own
            kept.append(track)
    return kept


def _successors(
    frames: list[_Sources],
    sky: list[Floats],
    others: list[NDArray[np.intp]],
    trees: list[cKDTree],
    k: int,
    i: int,
) -> NDArray[np.intp]:
    """Sources of the next frame, no stars, that source `i` of frame `k` may have become."""
    rows = others[k + 1][trees[k + 1].query_ball_point(sky[k][i], _REACH_PX)]
    ratio = frames[k + 1].flux[rows] / frames[k].flux[i]
    return rows[(ratio < _FLUX_RATIO) & (ratio > 1 / _FLUX_RATIO)]


def _follow(
    sky: list[Floats],
    others: list[NDArray[np.intp]],
    trees: list[cKDTree],
    seconds: Floats,
    k: int,
    start: Floats,
    velocity: Floats,
) -> dict[int, int]:
    """The sources along a straight line, outwards from frames k and k + 1."""
    track: dict[int, int] = {}
    for tried, m in enumerate(sorted(range(len(sky)), key=lambda m: abs(m - k - 0.4))):
        if tried == _LEAST_HITS and len(track) < _LEAST_HITS - 1:
            return {}
        place = start + velocity * (seconds[m] - seconds[k])
        distance, row = trees[m].query(place, distance_upper_bound=_LINK_PX)
        if not np.isfinite(distance):
            continue
        track[m] = int(others[m][row])
        if len(track) > 2:
            t = seconds[list(track)]
            path = np.array([sky[n][track[n]] for n in track])
            velocity = (t - t.mean()) @ (path - path.mean(0)) / np.sum((t - t.mean()) ** 2)
            start = path.mean(0) + velocity * (seconds[k] - t.mean())
    return track


def _detections(
    frame: _Sources, rows: NDArray[np.intp], velocity: Floats, track_id: NDArray[np.intp]
) -> NDArray[np.void]:
    found = np.zeros(len(rows), DETECTION_DTYPE)
    found["x"], found["y"] = frame.xy[rows].T
    found["vx"], found["vy"] = np.reshape(velocity, (-1, 2)).T
    found["snr"], found["flux"] = frame.snr[rows], frame.flux[rows]
    found["track_id"], found["status"] = track_id, CONFIRMED
    return found
