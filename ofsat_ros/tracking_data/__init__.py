# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Tracking data: the directions of tracks as files that orbit determination reads.

Stands after the detections have got their directions: the command ``ofsat process --tdm`` and the
node ``tdm_writer`` collect them in `TrackArcs` and write them through here.  Formats: CCSDS
Tracking Data Messages as text and as XML (`tdm`), and the IOD lines of SeeSat-L (`iod`).

No maintained library of a licence that fits writes right ascensions and declinations: ccsds-ndm,
which reads them back in the tests, is under the GPL, and beyond has azimuth and elevation only.
So the formats, which are small, are written here with the standard library.
"""

from ofsat_ros.tracking_data.arcs import ARC_DTYPE, Arc
from ofsat_ros.tracking_data.files import (
    SUFFIXES,
    TRACKING_DATA,
    TrackArcs,
    remove_parts,
    write_arcs,
)

__all__ = [
    "ARC_DTYPE",
    "SUFFIXES",
    "TRACKING_DATA",
    "Arc",
    "TrackArcs",
    "remove_parts",
    "write_arcs",
]
