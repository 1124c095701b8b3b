# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How well each engine measures a motion: of one star, and of the star field.

``python -m benchmarks.engines`` shifts a field of some 225 stars, Gaussians of sigma 1 px in 16
bits, by a known motion from one frame to the next, and prints two Markdown tables: how far each
engine's vectors are off, beside the bound of Cramer and Rao for two frames, and up to which motion
it still finds the field's.  Nothing but the pipeline's first two frames is used.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ofsat_ros.frame_result import FrameResult
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline

Array = NDArray[np.float64]

METHODS = {
    "`robust`, sparse": Parameters.preset("robust", engine="sparse"),
    "`robust`, dense": Parameters.preset("robust", engine="dense"),
    "`paper_opencv`": Parameters.preset("paper_opencv"),
    "`paper_matlab`": Parameters.preset("paper_matlab"),
}
SNRS = (10.0, 20.0, 50.0, 200.0, 30_000.0)
SPEEDS_PX = (0.1, 0.3, 0.6, 0.9, 1.5, 3.0, 6.0, 9.0, 12.0, 16.0, 24.0, 50.0, 100.0, 150.0)
_MOTION = np.array([0.37, -0.61])
_SIDE, _SPACING_PX, _PSF_PX = 512, 34.0, 1.0
_BACKGROUND, _NOISE, _WHITE = 1000.0, 10.0, 65535
# px; what is farther from a star, or off by more, is no measurement of it.
_NEAR_PX, _LOST_PX = 1.5, 1.0
# px; the star field's motion is found if it is off by less.
_FOUND_PX = 0.1
_SKY_SNR = 50.0


def field(random: np.random.Generator, motion: Array) -> Array:
    """Return places of stars, one in each cell, some of which are in the second frame only."""
    reach = _SPACING_PX * np.ceil(np.abs(motion).max() / _SPACING_PX + 1)
    axis = np.arange(-reach, _SIDE + reach, _SPACING_PX)
    cells = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return cells + random.uniform(0.25, 0.75, cells.shape) * _SPACING_PX


def image(random: np.random.Generator, places: Array, snr: float) -> NDArray[np.uint16]:
    """Render stars of one SNR, integrated over the pixels, with noise."""
    flux = 2 * np.sqrt(np.pi) * _PSF_PX * _NOISE * snr
    edges = np.arange(_SIDE + 1) - 0.5
    x, y = (np.diff(ndtr((edges - each[:, None]) / _PSF_PX), axis=1) for each in places.T)
    dn = flux * y.T @ x + _BACKGROUND + random.normal(0, _NOISE, (_SIDE, _SIDE))
    return np.clip(np.rint(dn), 0, _WHITE).astype(np.uint16)


def compare(method: Parameters, snr: float, motion: Array, seed: int) -> tuple[Array, Array]:
    """Return the errors of each star's motion, (N, 2) px, and of the field's, (2,) px.

    The latter are NaN where no motion of a field was found.
    """
    random = np.random.default_rng(seed)
    before = field(random, motion)
    pipeline = Pipeline(method)
    pipeline.process(image(random, before, snr), 10**18)
    result = pipeline.process(image(random, before + motion, snr), 10**18 + 10**9)
    found = np.full(2, np.nan)
    if result.star_field is not None:
        found = np.array(result.star_field.displacement)
    return _errors(result, before + motion, motion), found - motion


def _errors(result: FrameResult, places: Array, motion: Array) -> Array:
    flow = result.flow
    ends, steps = flow.position[flow.valid], flow.displacement[flow.valid]
    if not len(ends):
        return np.zeros((0, 2))
    away = np.linalg.norm(ends[:, None] - places, axis=2)
    nearest = away.argmin(axis=0)  # of several corners of a star, one
    near = away.min(axis=0) < _NEAR_PX
    errors = steps[nearest[near]] - motion
    return errors[np.linalg.norm(errors, axis=1) < _LOST_PX]


def error_table(seeds: Sequence[int]) -> Iterator[str]:
    """Yield the lines of the table of errors."""
    yield f"| SNR | bound | {' | '.join(METHODS)} |"
    yield "|---" * (len(METHODS) + 2) + "|"
    for snr in SNRS:
        saturated = snr == SNRS[-1]
        cells = ["saturated", "-"] if saturated else [f"{snr:g}", f"{2 * _PSF_PX / snr:.3f}"]
        for method in METHODS.values():
            pairs = [compare(method, snr, _MOTION, seed) for seed in seeds]
            stars = np.concatenate([stars for stars, _ in pairs])
            rms, length = np.nan, np.nan
            if len(stars):
                rms = np.sqrt(np.mean(stars**2))
                length = np.median(np.linalg.norm(stars, axis=1))
            whole = np.sqrt(np.mean([np.sum(off**2) for _, off in pairs]))
            cells.append(f"{rms:.3f} / {length:.3f} / {whole:.3f}")
        yield f"| {' | '.join(cells)} |"


def speed_table(seeds: Sequence[int], speeds: Sequence[float]) -> Iterator[str]:
    """Yield the lines of the table of motions."""
    yield f"| px per frame | {' | '.join(METHODS)} |"
    yield "|---" * (len(METHODS) + 1) + "|"
    for speed in speeds:
        motion = speed * np.array([0.8, 0.6])
        cells = []
        for method in METHODS.values():
            off = [compare(method, _SKY_SNR, motion, seed)[1] for seed in seeds]
            found = sum(np.linalg.norm(each) < _FOUND_PX for each in off)
            cells.append(f"{found} of {len(off)}")
        yield f"| {speed:g} | {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Measure how well engines measure motions.")
    parser.add_argument("--seeds", type=int, default=2, help="skies of each cell (%(default)s)")
    options = parser.parse_args(arguments)
    seeds = range(1, options.seeds + 1)
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, OpenCV {cv2.__version__};"
        f" {options.seeds} skies a cell; px: rms per axis of one star / median length of one"
        " star's error / the star field's error\n"
    )
    for line in error_table(seeds):
        print(line, flush=True)
    print(f"\nSkies in which the star field's motion was found to {_FOUND_PX} px\n")
    for line in speed_table(seeds, SPEEDS_PX):
        print(line, flush=True)


if __name__ == "__main__":
    main()
