# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What was found, in the forms in which others read it.

Stands after the pipeline: the command ``ofsat process`` and the nodes write through here, so that
a result reads the same whoever made it: CSV files (tables.py), messages (messages.py) and a bag of
them (bag.py), and ``run.json``, which says how they were made (run.py).
"""

from ofsat_ros.results.reading import read_table
from ofsat_ros.results.run import RUN, ResultError, read_run, write_run, write_whole
from ofsat_ros.results.tables import (
    DETECTION_COLUMNS,
    DETECTIONS,
    STAR_FIELD,
    STAR_FIELD_COLUMNS,
    TRACK_COLUMNS,
    TRACKS,
    ResultWriter,
    detection_lines,
    in_words,
)

__all__ = [
    "DETECTIONS",
    "DETECTION_COLUMNS",
    "RUN",
    "STAR_FIELD",
    "STAR_FIELD_COLUMNS",
    "TRACKS",
    "TRACK_COLUMNS",
    "ResultError",
    "ResultWriter",
    "detection_lines",
    "in_words",
    "read_run",
    "read_table",
    "write_run",
    "write_whole",
]
