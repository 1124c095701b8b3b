# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Preprocessing: from an image to what is bright in it.

First stage: background, defects of the sensor, Gaussian smoothing and threshold.
"""

from ofsat_ros.preprocessing.blank import blank_words
from ofsat_ros.preprocessing.defects import SensorMemory
from ofsat_ros.preprocessing.stage import Preprocessed, learn, preprocess

__all__ = ["Preprocessed", "SensorMemory", "blank_words", "learn", "preprocess"]
