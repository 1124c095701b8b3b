# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Places and paths on the sky: what lies how near to what, right across 0h and the poles."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def unit_vectors(ra_deg: ArrayLike, dec_deg: ArrayLike) -> Array:
    """Return directions (...,) as unit vectors (..., 3)."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack([np.cos(ra) * np.cos(dec), np.sin(ra) * np.cos(dec), np.sin(dec)], axis=-1)


def angles(a: Array, b: Array) -> Array:
    """Return the angles between unit vectors (..., 3), rad; exact for small ones too."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def cap_of(places: Array) -> tuple[Array, float]:
    """Return a small cap that holds places (N, 3) and the great circles between neighbours.

    Returns
    -------
    middle : (3,) float64
        Unit vector.
    radius : float
        rad.
    """
    middle = places.sum(axis=0)
    size = float(np.linalg.norm(middle))
    if size < 1e-9:  # all round the sphere
        return np.array([0.0, 0.0, 1.0]), float(np.pi)
    middle = middle / size
    away = angles(places, middle)
    # A cap of less than half the sphere holds the great circles between its places.
    radius = float(away.max())
    return middle, radius if radius < np.pi / 2 else float(np.pi)


def distance_to_arcs(place: Array, starts: Array, ends: Array) -> Array:
    """Return how far great circles (each the short way) stay from a place, (N,) rad.

    Parameters
    ----------
    place : (3,) float64
    starts, ends : (N, 3) float64
        Unit vectors; the same one twice is a place.
    """
    pole = np.cross(starts, ends)
    to_ends = np.minimum(angles(starts, place), angles(ends, place))
    # Whether the nearest place of the whole circle lies between the ends.
    between = (np.cross(pole, starts) @ place > 0) & (np.cross(ends, pole) @ place > 0)
    to_circle = np.arctan2(np.abs(pole @ place), np.linalg.norm(np.cross(pole, place), axis=-1))
    return np.where(between, to_circle, to_ends)
