# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Frames of the history, and spots, for tests of what comes after the images."""

from collections.abc import Callable

import numpy as np

from ofsat_ros.detection import SPOT_DTYPE
from ofsat_ros.history import PastFrame
from ofsat_ros.objects import OBJECT_DTYPE, find_objects
from ofsat_ros.parameters import Parameters
from ofsat_ros.pixels import Regions
from ofsat_ros.preprocessing import preprocess

# Place of something in a frame, px, by the frame's number.
Path = Callable[[float], np.ndarray]
SECOND_NS = 1_000_000_000


def frame_of(number: int, side: int = 256, to_sky: np.ndarray | None = None) -> PastFrame:
    """Return a black frame of one in a second, without objects."""
    black = np.zeros((side, side), np.float32)
    return PastFrame(
        number=number,
        stamp_ns=number * SECOND_NS,
        smoothed=black,
        noise=1.0,
        noise_ratio=np.ones((1, 1), np.float32),
        objects=np.zeros(0, OBJECT_DTYPE),
        regions=Regions((side, side)),
        to_sky=np.eye(3) if to_sky is None else to_sky,
    )


def past(
    image: np.ndarray, number: int = 0, to_sky: np.ndarray | None = None, step_ns: int = SECOND_NS
) -> PastFrame:
    """Return an image's frame as the pipeline puts it into the history."""
    pre = preprocess(image, Parameters())
    measured = pre.pixel_noise, pre.noise, pre.noise_ratio
    objects, regions = find_objects(pre.above, pre.image_at(pre.above), pre.smoothed, *measured)
    return PastFrame(
        number=number,
        stamp_ns=number * step_ns,
        smoothed=pre.smoothed,
        noise=pre.noise,
        noise_ratio=pre.noise_ratio,
        objects=objects,
        regions=regions,
        bright=pre.bright,
        to_sky=np.eye(3) if to_sky is None else to_sky,
    )


def spots_at(xy, excess) -> np.ndarray:
    """Return clean spots at places (N, 2) px, each of a point source of that many sigmas."""
    xy = np.reshape(xy, (-1, 2)).astype(float)
    spots = np.zeros(len(xy), SPOT_DTYPE)
    spots["x"], spots["y"] = xy.T
    spots["excess"] = spots["snr"] = excess
    spots["flux"] = 100 * spots["excess"]
    # As detection states it.
    spots["sigma_x"] = spots["sigma_y"] = 1.4 / np.maximum(spots["excess"], 1)
    spots["clean"], spots["object_index"] = True, -1
    return spots


def noise_spots(rng: np.random.Generator, side: int, least: float = 3.0) -> np.ndarray:
    """Return the peaks over `least` sigmas of noise smoothed with sigma 1 px.

    Their number per px^2 over u is (2 pi)^-3/2 / 2 u exp(-u^2 / 2) (Adler, "The geometry of
    random fields", 1981).
    """
    u = np.linspace(least, 9, 2000)
    over = (2 * np.pi) ** -1.5 / 2 * u * np.exp(-(u**2) / 2) * side**2
    count = rng.poisson(over[0])
    excess = np.interp(rng.uniform(0, 1, count), 1 - over / over[0], u)
    return spots_at(rng.uniform(0, side - 1, (count, 2)), excess)


def regions_of(labels: np.ndarray) -> Regions:
    """Return the regions of an image (H, W) of 1 + index of the object, 0 for none."""
    pixels = np.flatnonzero(labels)
    return Regions(labels.shape, pixels, labels.ravel()[pixels].astype(np.intp) - 1)


def labels_of(regions: Regions) -> np.ndarray:
    """Return the image (H, W) of 1 + index of the object, 0 for none."""
    labels = np.zeros(regions.shape, np.int32)
    labels.ravel()[regions.pixels] = regions.owner + 1
    return labels
