# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Tracking: spots over time become tracks.

Sixth stage: takes the history and what ``detection`` found in its frames, and says which of it is
an RSO: what lies on a path that chance does not explain.  Tracks keep their ids, coast through
gaps, and end.
"""

from ofsat_ros.tracking.linking import Link, find_links
from ofsat_ros.tracking.rows import COASTING, TRACK_DTYPE, Settled
from ofsat_ros.tracking.sightings import Sighting
from ofsat_ros.tracking.tracker import Tracked, Tracker

__all__ = [
    "COASTING",
    "TRACK_DTYPE",
    "Link",
    "Settled",
    "Sighting",
    "Tracked",
    "Tracker",
    "find_links",
]
