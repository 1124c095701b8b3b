# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Detection: what does not move with the star field.

Fifth stage.  `detect` compares two frames, as published; `find_spots` and `find_drifting` compare
a frame with the history and leave it to ``tracking`` to tell RSOs from noise.
"""

from ofsat_ros.detection.appearance import BORDER_PX, SPOT_DTYPE, find_spots, spot_near
from ofsat_ros.detection.drift import Drift, find_drifting
from ofsat_ros.detection.refinement import WINGS_PX, refine
from ofsat_ros.detection.two_frames import (
    CANDIDATE,
    CONFIRMED,
    DETECTION_DTYPE,
    DIRECTION_FIELDS,
    MEASURED_FIELDS,
    POINT_WIDTH_PX,
    detect,
)

__all__ = [
    "BORDER_PX",
    "CANDIDATE",
    "CONFIRMED",
    "DETECTION_DTYPE",
    "DIRECTION_FIELDS",
    "MEASURED_FIELDS",
    "POINT_WIDTH_PX",
    "SPOT_DTYPE",
    "WINGS_PX",
    "Drift",
    "detect",
    "find_drifting",
    "find_spots",
    "refine",
    "spot_near",
]
