"""Preprocessing: from an image to what is bright in it.

First stage: background, defects of the sensor, Gaussian smoothing and threshold.
"""

from ofsat_ros.preprocessing.blank import blank_words
from ofsat_ros.preprocessing.defects import SensorMemory
from ofsat_ros.preprocessing.stage import Preprocessed, preprocess

__all__ = ["Preprocessed", "SensorMemory", "blank_words", "preprocess"]
