# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Folders of results as ``ofsat process`` writes them, made up, for a catalogue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ofsat_ros.results import (
    DETECTION_COLUMNS,
    DETECTIONS,
    STAR_FIELD,
    STAR_FIELD_COLUMNS,
    TRACK_COLUMNS,
    TRACKS,
    write_run,
)

NAN = float("nan")
# 2026-03-01 20:00:00
EVENING_NS = 1_772_395_200_000_000_000
HOUR_NS = 3600 * 10**9


@dataclass(frozen=True)
class Seen:
    """A track: where on the sky in each of its frames, one a second from the first on."""

    number: int
    places: Sequence[tuple[float, float]]  # ra, dec, degrees
    snr: float = 10.0
    flux: float = 1000.0
    rel: tuple[float, float] = (3.0, -4.0)  # px/s
    first: int = 2


def archived(
    folder: Path,
    tracks: Sequence[Seen] = (),
    *,
    start_ns: int = EVENING_NS,
    frames: int = 150,
    blind: range = range(0),
    **run: object,
) -> Path:
    """Write the folder of one recording: a frame a second, 300 stars, noise 4."""
    folder.mkdir(parents=True)
    stamps = [start_ns + i * 10**9 for i in range(frames)]
    sums, found, field = [TRACK_COLUMNS], [DETECTION_COLUMNS], [STAR_FIELD_COLUMNS]
    for one in tracks:
        vx, vy = one.rel
        last = one.first + len(one.places) - 1
        x, y = 100 + vx * (last - one.first), 200 + vy * (last - one.first)
        sums.append(
            (one.number, stamps[one.first], stamps[last], one.first, last, len(one.places))
            + (100, 200, x, y, vx, vy, vx, vy, one.snr, one.flux, 2.5)
        )
        for i, (ra, dec) in enumerate(one.places):
            found.append(
                (stamps[one.first + i], one.first + i, one.number, 1, 100 + vx * i, 200 + vy * i)
                + (vx, vy, vx, vy, 0.2, 0.2, one.snr, one.flux, 2.5, 0, ra, dec)
            )
    # A candidate, which is no track.
    found.append((stamps[0], 0, 0, 0, 5, 5, *(0,) * 4, 0.2, 0.2, 4, 50, 2, 0, 1, 1))
    for i, stamp in enumerate(stamps):
        motion = (0.4, 0.1) if i and i not in blind else (NAN, NAN)
        stars = 300 if i and i not in blind else 0
        field.append(
            (stamp, i, 1 if i else NAN, *motion, *motion, 0, 1, 0.01, 0.01, 0.2)
            + (stars, 320, len(tracks), 100, 4, 16, '""')
        )
    for name, rows in ((TRACKS, sums), (DETECTIONS, found), (STAR_FIELD, field)):
        text = "".join(",".join(map(str, row)) + "\n" for row in rows)
        (folder / name).write_text(text)
    unlocated = int(sum(np.isnan(place).any() for one in tracks for place in one.places))
    about = {
        **{"version": "0.1.0", "recording": f"/data/{folder.name}.bag", "topic": "/camera/image"},
        **{"preset": "robust", "parameters": {"spot_sigmas": 4.5}, "live": False},
        **{"frames": frames, "left_out": 0, "width": 640, "height": 480},
        **{"first_stamp_ns": stamps[0], "last_stamp_ns": stamps[-1]},
        **{"started_utc": "2026-03-02T08:00:00+00:00", "seconds": 12.5, "stopped": False},
        **{"problems": [], "unlocated": {"no attitude": unlocated} if unlocated else {}},
    }
    write_run(folder, about | run)
    return folder
