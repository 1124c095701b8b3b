# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Evaluation: how well detections agree with the truth.

Stands after the result files and beside the benchmarks: takes the truth of a sequence and the
detections that a method made of it, matches them frame by frame, and says what was found, what was
missed and what was invented.  The rules:

- Frame 0 never counts: there is nothing to compare it with.
- A detection matches a truth within 2 px; for a streak (length of 4 px and more) within
  max(2, length / 2) px along its motion and 2 px across.  One to one, by assignment.
- Truth cut by the border, or of SNR under 3, is don't-care: neither a miss nor, when detected, a
  false alarm.  Truth of unknown SNR counts, but belongs to no range of SNR.
- A second detection of the same object, within 1.5 times the tolerance, is a duplicate, and
  counted apart.
- Live, truth counts from the third frame on in which its object is visible (its SNR is 3 or more,
  or unknown); before, it is don't-care.  False alarms count in all frames.
"""

from ofsat_ros.evaluation.scoring import (
    DUPLICATE,
    FALSE_ALARM,
    FOUND,
    IGNORED,
    MISSED,
    OUTCOME_DTYPE,
    SNR_RANGES,
    Evaluation,
    evaluate,
    merge,
)
from ofsat_ros.evaluation.tables import (
    DETECTIONS_DTYPE,
    TRUTH_DTYPE,
    EvaluationError,
    count_frames,
    detection_table,
    read_detections,
    read_truth,
)

__all__ = [
    "DETECTIONS_DTYPE",
    "DUPLICATE",
    "FALSE_ALARM",
    "FOUND",
    "IGNORED",
    "MISSED",
    "OUTCOME_DTYPE",
    "SNR_RANGES",
    "TRUTH_DTYPE",
    "Evaluation",
    "EvaluationError",
    "count_frames",
    "detection_table",
    "evaluate",
    "merge",
    "read_detections",
    "read_truth",
]
