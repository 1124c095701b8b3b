# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a lens does: from the direction of light to a point of the image plane.

Points here are in units of the focal length, (pixel - principal point) / f; a camera adds the
matrix.  The formulas are those that ROS cameras are calibrated with: `plumb_bob` and
`rational_polynomial` of OpenCV's calib3d ("Detailed Description"; D. C. Brown, "Decentering
Distortion of Lenses", 1966) and its fisheye model (J. Kannala, S. Brandt, "A Generic Camera Model
and Calibration Method", 2006), named in sensor_msgs/distortion_models and REP 104.

OpenCV stops its own inversion after a few steps, far from the solution where the distortion is
strong, and past the fold of a model it returns a wrong point; so the inversion is done here.  A
model is trusted from the axis outwards up to where it stops to be one to one; beyond, all is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]
# du/dx, du/dy, dv/dx, dv/dy of an image (u, v) of points (x, y), each of the points' shape.
Slopes = tuple[Array, Array, Array, Array]

# Radii at which a model is examined, and directions at each of them.
_RADII, _DIRECTIONS = 512, 24
# A model that compresses the image so much more than at its axis has folded over.
_LEAST_SLOPE = 1e-6
_TABLE = 4096
_STEPS = 15
_UNIT = np.eye(3)
_TINY = np.finfo(float).tiny
_PRECISION = 1e-12
# Beside 1, of what is multiplied with powers of the field.
_NEGLIGIBLE = 1e-40


class Lens(Protocol):
    """A distortion model."""

    def project(self, sight: Array) -> Array:
        """Return points (N, 2) of directions (N, 3) of any length; NaN outside the domain."""

    def sights(self, points: Array, tolerance: float) -> tuple[Array, Array]:
        """Return unit directions (N, 3) of points (N, 2) and their derivatives (N, 3, 2).

        NaN where the model cannot be inverted to within `tolerance`, in units of the focal
        length (far outside the image, to within a part in 10^12).
        """


class Pinhole:
    """No distortion: x / z, y / z."""

    def project(self, sight: Array) -> Array:
        """See `Lens`."""
        z = sight[:, 2:]
        return sight[:, :2] / np.where(z > 0, z, np.nan)

    def sights(self, points: Array, tolerance: float) -> tuple[Array, Array]:
        """See `Lens`."""
        length = np.sqrt(1 + np.square(points).sum(1))[:, None]
        length[np.isinf(length)] = np.nan  # no direction of length 0
        sight = np.empty((len(points), 3))
        sight[:, :2], sight[:, 2:] = points / length, 1 / length
        # The part of a step on the plane that is across the direction, over the distance.
        slopes = _UNIT[:, :2] - sight[:, :, None] * sight[:, None, :2]
        return sight, slopes / length[:, :, None]


class Brown:
    """Radial (polynomial or rational), tangential and thin prism distortion of the plane.

    Parameters
    ----------
    coefficients : (12,) float64
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 as OpenCV orders them.
    extent : float
        Distance of the farthest corner of the image, in units of the focal length.
    """

    def __init__(self, coefficients: Array, extent: float) -> None:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = coefficients.tolist()
        self._numerator, self._denominator = (k1, k2, k3), (k4, k5, k6)
        self._tangential, self._prism = (p1, p2), (s1, s2, s3, s4)
        angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
        along_x, along_y = np.cos(angles), np.sin(angles)

        def one_to_one(radii: Array) -> NDArray[np.bool_]:
            _, slopes = self._distort(radii[:, None] * along_x, radii[:, None] * along_y)
            return np.asarray((_least_stretch(slopes) > _LEAST_SLOPE).all(1))

        end = self._radial_end(extent)
        radii = np.geomspace(1e-3 * min(extent, end), min(1e3 * max(1.0, extent), end), _RADII)
        valid = _valid_part(radii, one_to_one)
        self._limit = valid[-1]
        # The inverse of the radial part, for the start of a search.
        self._radii = np.interp(np.linspace(0, len(valid) - 1, _TABLE), range(len(valid)), valid)
        self._distorted = self._radii * self._radial(self._radii**2)[0]
        edge, _ = self._distort(self._limit * along_x, self._limit * along_y)
        self._reach = 1.02 * np.hypot(*edge).max()

    def project(self, sight: Array) -> Array:
        """See `Lens`."""
        x, y = Pinhole().project(sight).T
        inside = np.hypot(x, y) <= self._limit
        image, _ = self._distort(np.where(inside, x, np.nan), y)
        return np.stack(image, -1)

    def sights(self, points: Array, tolerance: float) -> tuple[Array, Array]:
        """See `Lens`."""
        plane, slopes = self._undistort(points, tolerance)
        sight, spread = Pinhole().sights(plane, tolerance)
        return sight, spread @ _inverse(slopes)

    def _radial_end(self, extent: float) -> float:
        """Return where the radial part stops to grow, or is infinite."""
        above, below = (Polynomial([1.0, *each]) for each in (self._numerator, self._denominator))
        # The part is r N(s) / D(s) with s = r^2; its derivative times D(s)^2 is a polynomial.
        s = Polynomial([0.0, 1.0])
        slope = (above + 2 * s * above.deriv()) * below - 2 * s * above * below.deriv()
        return min(_first_root(slope, extent**2), _first_root(below, extent**2)) ** 0.5

    def _radial(self, r2: Array) -> tuple[Array, Array]:
        """Return the radial factor and its derivative by the squared radius."""
        (k1, k2, k3), (k4, k5, k6) = self._numerator, self._denominator
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        slope = k1 + r2 * (2 * k2 + 3 * k3 * r2) - factor * (k4 + r2 * (2 * k5 + 3 * k6 * r2))
        return factor, slope / below

    def _decentre(self, x: Array, y: Array, r2: Array) -> tuple[Array, Array, Array]:
        """Return what is added: to the radial factor, and by the square of the radius."""
        (p1, p2), (s1, s2, s3, s4) = self._tangential, self._prism
        return 2 * (p1 * y + p2 * x), p2 + s1 + s2 * r2, p1 + s3 + s4 * r2

    def _distort(self, x: Array, y: Array) -> tuple[tuple[Array, Array], Slopes]:
        """Return the image of points of the ideal plane, and the derivatives."""
        (p1, p2), (_, s2, _, s4) = self._tangential, self._prism
        r2 = x * x + y * y
        factor, slope = self._radial(r2)
        more, square_x, square_y = self._decentre(x, y, r2)
        factor = factor + more
        factor_x, factor_y = 2 * (slope * x + p2), 2 * (slope * y + p1)
        across_x, across_y = 2 * (square_x + s2 * r2), 2 * (square_y + s4 * r2)
        slopes = (
            factor + x * (factor_x + across_x),
            x * factor_y + y * across_x,
            y * factor_x + x * across_y,
            factor + y * (factor_y + across_y),
        )
        return (x * factor + r2 * square_x, y * factor + r2 * square_y), slopes

    def _undistort(self, points: Array, tolerance: float) -> tuple[Array, Slopes]:
        """Return the ideal plane's points (N, 2), and the derivatives there, by Newton's method.

        Where the derivative's symmetric part is positive throughout a disc, no two points of the
        disc have the same image: the point found inside is the only one.
        """
        distance = np.hypot(*points.T)
        allowed = np.maximum(tolerance, _PRECISION * distance)
        u, v = np.where(distance <= self._reach, points.T, np.nan)
        x, y = self._without_radial(u, v)
        r2 = x * x + y * y
        more, square_x, square_y = self._decentre(x, y, r2)
        x, y = self._without_radial(u - x * more - r2 * square_x, v - y * more - r2 * square_y)
        for step in range(_STEPS):
            image, slopes = self._distort(x, y)
            missed_x, missed_y = u - image[0], v - image[1]
            missed = np.hypot(missed_x, missed_y)
            if step == _STEPS - 1 or not (missed > allowed).any():
                break
            (a, b, c, d), scale = slopes, _determinant(slopes)
            x = x + (d * missed_x - b * missed_y) / scale
            y = y + (a * missed_y - c * missed_x) / scale
            # The solution is inside: a step that leaves the disc is cut short.
            excess = np.maximum(np.hypot(x, y) / self._limit, 1.0)
            x, y = x / excess, y / excess
        good = (missed <= allowed) & (_least_stretch(slopes) > 0)
        return np.where(good, [x, y], np.nan).T, slopes

    def _without_radial(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return nearly the points whose radial image is given."""
        distance = np.hypot(u, v)
        scale = np.interp(distance, self._distorted, self._radii) / (distance + _TINY)
        return u * scale, v * scale


class Fisheye:
    """Distance from the axis as an odd polynomial of the angle to it, beyond 90 degrees too.

    Parameters
    ----------
    coefficients : (4,) float64
        k1 to k4 of theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
    extent : float
        Distance of the farthest corner of the image, in units of the focal length.
    """

    def __init__(self, coefficients: Array, extent: float) -> None:
        self._coefficients = tuple(coefficients.tolist())

        def one_to_one(angles: Array) -> NDArray[np.bool_]:
            return np.asarray(self._distort(angles)[1] > _LEAST_SLOPE)

        k1, k2, k3, k4 = self._coefficients
        slope = Polynomial([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
        # At 180 degrees all directions of the image are one.
        end = min(np.sqrt(_first_root(slope, min(extent, 1.0) ** 2)), np.pi - 1e-9)
        angles = np.geomspace(1e-3 * min(extent, end), end, _RADII)
        self._angles = _valid_part(angles, one_to_one)
        self._distorted = self._distort(self._angles)[0]

    def project(self, sight: Array) -> Array:
        """See `Lens`."""
        across = np.hypot(sight[:, 0], sight[:, 1])
        angle = np.arctan2(across, sight[:, 2])
        angle[~((angle <= self._angles[-1]) & sight.any(1))] = np.nan
        distance, _ = self._distort(angle)
        return sight[:, :2] * (distance / (across + _TINY))[:, None]

    def sights(self, points: Array, tolerance: float) -> tuple[Array, Array]:
        """See `Lens`."""
        distance = np.hypot(*points.T)
        angle, slope = self._undistort(distance, tolerance)
        on_axis = distance == 0
        outwards = points / np.where(on_axis, 1.0, distance)[:, None]
        outwards[on_axis] = (1.0, 0.0)
        sine, cosine = np.sin(angle), np.cos(angle)
        sight, along = np.empty((len(points), 3)), np.empty((len(points), 3))
        sight[:, :2], sight[:, 2] = sine[:, None] * outwards, cosine
        along[:, :2], along[:, 2] = cosine[:, None] * outwards, -sine
        sideways = np.zeros((len(points), 3))
        sideways[:, 0], sideways[:, 1] = -outwards[:, 1], outwards[:, 0]
        widening = np.where(on_axis, 1.0, sine / np.where(on_axis, 1.0, distance))
        slopes = (along / slope[:, None])[:, :, None] * outwards[:, None, :]
        slopes += (widening[:, None] * sideways)[:, :, None] * sideways[:, None, :2]
        return sight, slopes

    def _distort(self, angle: Array) -> tuple[Array, Array]:
        k1, k2, k3, k4 = self._coefficients
        a2 = angle * angle
        distance = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
        return distance, slope

    def _undistort(self, distance: Array, tolerance: float) -> tuple[Array, Array]:
        allowed = np.maximum(tolerance, _PRECISION * distance)
        distance = np.where(distance <= self._distorted[-1] + allowed, distance, np.nan)
        angle = np.interp(distance, self._distorted, self._angles)
        for _ in range(_STEPS):
            reached, slope = self._distort(angle)
            missed = distance - reached
            if not (np.abs(missed) > allowed).any():
                break
            angle = np.clip(angle + missed / slope, 0.0, self._angles[-1])
        return np.where(np.abs(missed) <= allowed, angle, np.nan), slope


def _valid_part(radii: Array, valid: Callable[[Array], NDArray[np.bool_]]) -> Array:
    """Return 0 and the radii before the first at which a model fails, to a fine end.

    Raises
    ------
    ValueError
        If the model fails at the first of them.
    """
    good = valid(radii)
    if good.all():
        return np.concatenate([[0.0], radii])
    bad = int(np.argmin(good))
    if not bad:
        raise ValueError("the distortion folds over next to the principal point")
    between = np.linspace(radii[bad - 1], radii[bad], _RADII)
    fine = between[: int(np.argmin(valid(between)))]
    return np.concatenate([[0.0], radii[: bad - 1], fine])


def _first_root(polynomial: Polynomial, scale: float) -> float:
    """Return the least positive real root, or infinity; `scale` is of the arguments' order."""
    coefficients = np.asarray(polynomial.coef, float)
    coefficients = coefficients * scale ** np.arange(coefficients.size)
    coefficients[np.abs(coefficients) < _NEGLIGIBLE] = 0
    roots = scale * np.roots(coefficients[::-1])
    # Of a double root rounding makes a pair beside the real axis.
    real = roots.real[(np.abs(roots.imag) < 1e-6 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def _least_stretch(slopes: Slopes) -> Array:
    """Return the lesser eigenvalue of the matrices' symmetric part."""
    a, b, c, d = slopes
    return ((a + d) - np.hypot(a - d, b + c)) / 2


def _determinant(slopes: Slopes) -> Array:
    a, b, c, d = slopes
    return a * d - b * c


def _inverse(slopes: Slopes) -> Array:
    """Return the inverse matrices, (N, 2, 2)."""
    a, b, c, d = slopes
    inverse = np.array([[d, -b], [-c, a]]) / _determinant(slopes)
    return inverse.transpose(2, 0, 1)
