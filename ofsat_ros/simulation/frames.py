# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a simulated frame is: an image, and the truth of what is in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

TRUTH_DTYPE = np.dtype(
    [("stamp_ns", "i8"), ("frame", "i4"), ("id", "u4")]
    + [(name, "f8") for name in ("x_px", "y_px", "vx_px_s", "vy_px_s")]
    + [(name, "f8") for name in ("snr", "flux", "length_px")]
)
STAR_DTYPE = np.dtype(
    [(name, "f8") for name in ("x_px", "y_px", "vx_px_s", "vy_px_s", "dx_px", "dy_px", "flux")]
)
_TRUTH_FORMAT = "%d,%d,%d,%.4f,%.4f,%.5f,%.5f,%.3f,%.2f,%.3f"


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One frame and its truth.

    Attributes
    ----------
    image : numpy.ndarray
        (height, width), uint8 or uint16, DN.
    stamp_ns : int
        Middle of the exposure, UTC, ns.
    frame : int
        Number of the frame, from 0.
    truth : numpy.ndarray
        TRUTH_DTYPE, a row for each RSO whose centre is inside the image: position at
        mid-exposure, jitter included, and velocity in the image then, without it; ``flux`` in
        DN, as clouds and vignetting leave it, in the mean of this exposure; ``snr`` of a matched
        filter on this one frame, sqrt(sum s_i^2 / var_i) over the pixels that see that flux;
        ``length_px`` of its streak.  var_i has all that is random to whoever doesn't know the
        sensor: photon noise of all light and dark signal, sensor noise, rounding, the offsets'
        variance, and that of the gains times the light squared.  Left out: the levels of stars,
        sky and hot pixels, taken as known; cosmic rays; saturation.
    relative_velocity_px_s : numpy.ndarray
        (rows of truth, 2), velocity of each RSO against the star field where it is, px/s.
    stars : numpy.ndarray
        STAR_DTYPE, a row for each star whose centre is inside: position at mid-exposure,
        velocity, displacement since the frame before (NaN in the first frame), flux in DN before
        clouds and vignetting.
    displacement_px : numpy.ndarray
        (2,), displacement since the frame before of a star now at the image's centre, px, jitter
        included; NaN in the first frame.
    rotation_rad : float
        Turn of the field since the frame before, x axis towards y axis; NaN in the first frame.
    attitude : scipy.spatial.transform.Rotation
        Rotation ICRS -> optical frame at mid-exposure, without jitter.
    """

    image: np.ndarray
    stamp_ns: int
    frame: int
    truth: np.ndarray
    relative_velocity_px_s: np.ndarray
    stars: np.ndarray
    displacement_px: np.ndarray
    rotation_rad: float
    attitude: Rotation


def write_truth(path: str | Path, frames_truth: Iterable[np.ndarray]) -> None:
    """Write the truth of many frames as ``truth.csv``.

    Parameters
    ----------
    path : str or Path
        File to write; an older one is replaced.
    frames_truth : iterable of numpy.ndarray
        TRUTH_DTYPE, one array per frame, in time order.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(",".join(TRUTH_DTYPE.names or ()) + "\n")
        for rows in frames_truth:
            # + 0: a zero of negative sign is written as a plain one.
            file.writelines(
                _TRUTH_FORMAT % tuple(value + 0 for value in row) + "\n" for row in rows.tolist()
            )
