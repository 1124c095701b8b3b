# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Assignment: which of a frame's spots and objects is which track's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import MEASURED_FIELDS, SPOT_DTYPE
from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import as_complex, positions
from ofsat_ros.tracking.sightings import SPREAD_PX, Sighting
from ofsat_ros.tracking.track import Track, covariances, predict

Array = NDArray[np.float64]

# A spot this far from where a track is expected, in sigmas, is not its.
_GATE_SIGMAS = 4.0
# An object may be a slow track's sight; a fast track would take a star for it, px per frame.
SLOW_PX = 2.0
_FLUX_RATIO = 3.0
# What is longer than the track by more than some such steps has grown together with a star, px.
_LONGER_PX = 1.5
# Farther from where it is expected, beyond half of what it moves in a frame, it is not sought, px.
_FARTHEST_PX = 50.0
# The distance of what cannot be.
_NEVER = 1e6


def assign(
    tracks: Sequence[Track], frame: PastFrame, sighting: Sighting
) -> tuple[NDArray[np.intp], NDArray[np.void]]:
    """Rows of tracks, and the spot of each, such that their distances are least in all."""
    if not tracks:
        return np.zeros(0, np.intp), np.zeros(0, SPOT_DTYPE)
    from scipy.optimize import linear_sum_assignment  # no frame without tracks waits for it

    row, column, spots, distance = _candidates(tracks, frame, sighting)
    # What is beyond the gate must not weigh in what others get.
    good = np.flatnonzero(distance < _GATE_SIGMAS**2)
    row = row[good]
    columns, column = np.unique(column[good], return_inverse=True)
    cost = np.full((len(tracks), len(columns)), _NEVER)
    cost[row, column] = distance[good]
    candidate = np.full(cost.shape, -1)
    candidate[row, column] = good
    row, column = linear_sum_assignment(cost)
    best = candidate[row, column]
    return row[best >= 0], spots[best[best >= 0]]


def as_spots(frame: PastFrame, rows: Sequence[int] | NDArray[np.intp]) -> NDArray[np.void]:
    """Objects of a frame as if they were spots."""
    objects = frame.objects[rows]
    spots = np.zeros(len(objects), SPOT_DTYPE)
    for name in MEASURED_FIELDS:
        spots[name] = objects[name]
    spots["excess"], spots["object_index"] = objects["snr"], rows
    return spots


def _candidates(
    tracks: Sequence[Track], frame: PastFrame, sighting: Sighting
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.void], Array]:
    """What tracks may take: the row of the track, and a number, the spot and its distance.

    Distances are squared and statistical, from where the track is expected.  A fast track takes
    spots, since it would take stars among the objects; a slow one takes objects of its brightness
    and shape, since a spot is only that side of it which has moved.
    """
    states, spread = predict(tracks, frame.stamp_ns)
    expected = states[:, :2]
    step = np.array([track.speed * track.frame_s for track in tracks])
    centre, reach, slow = as_complex(expected), _FARTHEST_PX + step / 2, step <= SLOW_PX
    index = sighting.spots["object_index"]
    near = [(i, k, d < reach[i]) for i, k, d in sighting.near(centre, reach)]
    row, number, good = (np.concatenate(part) for part in zip(*near, strict=True))
    good &= ~slow[row] | (index[number] >= 0)
    row, number = row[good], number[good]
    rest = np.ones(len(frame.objects), bool)
    rest[index[index >= 0]] = False
    rest = np.flatnonzero(rest)
    objects = as_complex(frame.object_sky[rest])
    slow_row = np.flatnonzero(slow)
    which, column = np.nonzero(np.abs(objects - centre[slow_row, None]) < reach[slow_row, None])
    spots = np.concatenate([sighting.spots[number], as_spots(frame, rest[column])])
    row = np.concatenate([row, slow_row[which]])
    number = np.concatenate([number, len(sighting.spots) + rest[column]])

    off = frame.sky(positions(spots)) - expected[row]
    spread = spread[row, :2, :2] + covariances(frame, spots) + SPREAD_PX**2 * np.eye(2)
    distance = np.sum(off * np.linalg.solve(spread, off[:, :, None])[:, :, 0], axis=1)
    flux, length = (
        np.array([getattr(track, name) for track in tracks])[row] for name in ("flux", "length")
    )
    ratio = np.log(np.maximum(spots["flux"], 1e-9) / np.maximum(flux, 1e-9)) / np.log(_FLUX_RATIO)
    longer = np.maximum(spots["length"] - length, 0) / _LONGER_PX
    distance += ratio**2 + longer**2
    distance[slow[row] & (np.abs(ratio) > 1)] = _NEVER
    return row, number, spots, distance
