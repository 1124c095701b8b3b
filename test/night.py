# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A folder of FITS files as a camera program leaves it, with plate solutions in the headers."""

from pathlib import Path

import numpy as np
from astropy.io import fits

from ofsat_ros.camera import to_radec
from ofsat_ros.simulation import SimulatedFrame, Simulator

AXES = np.eye(3)


def write_night(folder: Path, simulator: Simulator, exposure_s: float) -> None:
    """Write every frame of a simulator as FOLDER/light_001.fits and so on."""
    folder.mkdir()
    for shot in simulator:
        header = fits.Header(solution(shot, simulator.camera.matrix))
        start = np.datetime64(shot.stamp_ns - round(exposure_s * 5e8), "ns")
        header["DATE-OBS"], header["EXPTIME"] = str(start), exposure_s
        file = folder / f"light_{shot.frame + 1:03}.fits"
        fits.PrimaryHDU(shot.image, header).writeto(file)


def solution(shot: SimulatedFrame, matrix: np.ndarray) -> dict:
    """Cards of a tangential projection: where a frame's middle is, and where its axes point."""
    right, down, ahead = shot.attitude.inv().apply(AXES)
    (ra,), (dec,) = to_radec(AXES[2:], shot.attitude)
    east = np.array([-np.sin(ra), np.cos(ra), 0])
    north = np.cross(ahead, east)
    step = np.degrees(1 / matrix[0, 0])
    return {
        **{"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "RADESYS": "ICRS"},
        **{"CRVAL1": np.degrees(ra), "CRVAL2": np.degrees(dec)},
        # FITS counts from 1.
        **{"CRPIX1": matrix[0, 2] + 1, "CRPIX2": matrix[1, 2] + 1, "ROWORDER": "TOP-DOWN"},
        **{"CD1_1": step * (east @ right), "CD1_2": step * (east @ down)},
        **{"CD2_1": step * (north @ right), "CD2_2": step * (north @ down)},
    }
