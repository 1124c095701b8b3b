# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Suggestion: what a recording is like, and the parameters that suit it.

Stands beside ``processing``: it runs the same `Pipeline` over the first frames of a recording,
measures how wide the stars are, how dark the sky is and how the field moves (`measure`), and
compares that with what the defaults were made for (`suggest`).
"""

from ofsat_ros.suggestion.advice import Proposal, Suggestion, suggest
from ofsat_ros.suggestion.measurement import Measurement, measure

__all__ = ["Measurement", "Proposal", "Suggestion", "measure", "suggest"]
