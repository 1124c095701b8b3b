# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Images in which nothing can be seen: what they are like, in words for the observer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# The highest value of 8 bits; those of 10 to 16 bits, as cameras have them, are above.
_LEAST_FULL = 255


def blank_words(raw: NDArray[np.generic]) -> str:
    """Return what is wrong with an image in which no object was found; empty if nothing is.

    Parameters
    ----------
    raw : (H, W) uint8, uint16 or float32
        The image, DN, with a finite pixel.
    """
    values = raw if raw.dtype.kind == "u" else raw[np.isfinite(raw)]
    low, high = values.min(), values.max()
    full = values.dtype.kind == "u" and high >= _LEAST_FULL
    if full and 2 * np.count_nonzero(values == high) > values.size:
        return f"the image is saturated: most of its pixels are {high}, its highest value"
    if low == high:
        return f"the image is empty: all of its pixels are {low:g}; see to shutter, cap and camera"
    return ""
