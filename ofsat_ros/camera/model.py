# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The camera: pixels to lines of sight and back, and these to right ascension and declination."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ofsat_ros.camera.lens import Brown, Fisheye, Lens, Pinhole

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# An inversion counts if it leads back to the pixel this closely, px.
_TOLERANCE_PX = 1e-6
_MODELS = {"": "plumb_bob", "fisheye": "equidistant"}
# How many coefficients a model may come with; OpenCV's order, so what lacks at the end is 0.
_COUNTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (0, 4)}


class CameraError(ValueError):
    """A calibration or an attitude that cannot be used; the message says why."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    Lines of sight are unit vectors in the optical frame: x right, y down, z forward.

    Attributes
    ----------
    width, height : int
        Of the image, px.
    matrix : (3, 3) float64
        Focal lengths, skew and principal point, px; pixel (0, 0) is the top-left one's centre.
    distortion : (n,) float64
        Coefficients in OpenCV's order: k1, k2, p1, p2[, k3] of `plumb_bob`; k1, k2, p1, p2, k3,
        k4, k5, k6[, s1, s2, s3, s4[, 0, 0]] of `rational_polynomial`; k1 to k4 of `equidistant`.
    model : str
        ``plumb_bob``, ``rational_polynomial`` or ``equidistant``.

    Raises
    ------
    CameraError
        If the values are no calibration.
    """

    width: int
    height: int
    matrix: Array
    distortion: Array
    model: str
    _lens: Lens = field(init=False, repr=False)
    _inverse: Array = field(init=False, repr=False)

    @np.errstate(all="ignore")  # what overflows is no number, and refused as such
    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, float)
        distortion = np.array(self.distortion, float).ravel()
        model = _MODELS.get(self.model, self.model)
        if not self.model and distortion.any():
            raise CameraError("the calibration has distortion coefficients, but names no model")
        _check(self.width, self.height, matrix, distortion, model)
        matrix.setflags(write=False)
        distortion.setflags(write=False)
        inverse = np.linalg.inv(matrix[:2, :2])
        sides = [(-0.5, length - 0.5) for length in (self.width, self.height)]
        corners = np.array([(x, y) for x in sides[0] for y in sides[1]]) - matrix[:2, 2]
        extent = np.hypot(*(inverse @ corners.T)).max()
        if not np.isfinite(extent):
            raise CameraError("the calibration's values are absurd: no pixel has a direction")
        for name, value in (
            ("matrix", matrix),
            ("distortion", distortion),
            ("model", model),
            ("_inverse", inverse),
            ("_lens", _lens_of(model, tuple(distortion.tolist()), float(extent))),
        ):
            object.__setattr__(self, name, value)

    @classmethod
    @np.errstate(all="ignore")
    def from_calibration(
        cls,
        width: int,
        height: int,
        k: ArrayLike,
        d: ArrayLike,
        model: str,
        *,
        binning: tuple[int, int] = (1, 1),
        roi: Sequence[int] = (0, 0, 0, 0),
    ) -> Self:
        """Build from the values of a sensor_msgs/CameraInfo.

        Parameters
        ----------
        width, height : int
            Of the full-resolution image, px, as CameraInfo has them.
        k : (9,) float
            Matrix of the full-resolution image, row by row; K[0] is 0 if there is no calibration.
        d : (n,) float
            Distortion coefficients; none for an ideal lens.
        model : str
            As in the class; also "" (`plumb_bob`) and ``fisheye`` (`equidistant`).
        binning : (2,) int
            binning_x and binning_y; 0 is as 1.
        roi : (4,) int
            x_offset, y_offset, width and height, full-resolution px; width or height 0: to the
            image's end.  The image's pixel (0, 0) is then the region's first, and its centre is
            the mean of the sensor's pixels binned into it.

        Raises
        ------
        CameraError
            If the camera is not calibrated, the model unknown, or a value makes no sense.
        """
        values = np.array(k, float)
        if values.size != 9:
            raise CameraError(f"a camera's matrix has 9 values, not {values.size}")
        matrix = values.reshape(3, 3)
        bins = [max(int(each), 1) for each in binning]
        x, y, *size = (int(each) for each in roi)
        columns, rows = size[0] or int(width) - x, size[1] or int(height) - y
        if min(x, y) < 0 or not (0 < columns <= width - x and 0 < rows <= height - y):
            raise CameraError(f"region {tuple(roi)} is not within an image of {width} x {height}")
        matrix[:2, 2] -= (x - 0.5, y - 0.5)
        matrix[:2] /= np.array(bins, float)[:, None]
        matrix[:2, 2] -= 0.5
        return cls(columns // bins[0], rows // bins[1], matrix, np.array(d, float), model)

    @classmethod
    def from_message(cls, message: Any) -> Self:
        """Build from a sensor_msgs/CameraInfo, of ROS 2 or (in a bag) ROS 1, with what it bins.

        Raises
        ------
        CameraError
            As `from_calibration`.
        """
        k, d = (getattr(message, name, getattr(message, name.upper(), ())) for name in "kd")
        roi = message.roi
        try:
            return cls.from_calibration(
                message.width,
                message.height,
                k,
                d,
                message.distortion_model,
                binning=(message.binning_x, message.binning_y),
                roi=(roi.x_offset, roi.y_offset, roi.width, roi.height),
            )
        except (OverflowError, np.linalg.LinAlgError) as error:
            raise CameraError(f"the calibration's values are absurd: {error}") from error

    @classmethod
    def ideal(cls, width: int, height: int, pixel_scale_rad: float) -> Self:
        """Build a camera without distortion that looks along the middle of its image.

        Parameters
        ----------
        width, height : int
            px.
        pixel_scale_rad : float
            Angle that a pixel in the middle spans, rad.
        """
        if not 0 < pixel_scale_rad < np.inf:
            raise CameraError(f"a pixel cannot span {pixel_scale_rad} rad")
        f = 1 / pixel_scale_rad
        k = [f, 0, (width - 1) / 2, 0, f, (height - 1) / 2, 0, 0, 1]
        return cls.from_calibration(width, height, k, [], "plumb_bob")

    def lines_of_sight(self, xy: ArrayLike) -> Array:
        """Return the unit vectors, (N, 3), along which pixels look.

        Parameters
        ----------
        xy : (N, 2) float
            px, inside the image or not.

        Returns
        -------
        (N, 3) float64
            Optical frame; NaN where the distortion cannot be inverted.
        """
        return self.sights_with_jacobians(xy)[0]

    def jacobians(self, xy: ArrayLike) -> Array:
        """Return the derivatives of lines of sight by pixel coordinates, (N, 3, 2) rad/px.

        A pixel's covariance C gives the covariance J C J^T of its line of sight.
        """
        return self.sights_with_jacobians(xy)[1]

    def rates(self, xy: ArrayLike, velocity: ArrayLike) -> Array:
        """Return how lines of sight turn, (N, 3) rad/s, of points that move in the image.

        Parameters
        ----------
        xy : (N, 2) float
            px.
        velocity : (N, 2) float
            px/s.  Against the star field, the rates are inertial; in the image, relative to the
            camera.  Both are in the axes of the optical frame.
        """
        moved: Array = self.sights_with_jacobians(xy)[1] @ _pairs(velocity)[:, :, None]
        return moved[:, :, 0]

    @np.errstate(all="ignore")
    def sights_with_jacobians(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Return `lines_of_sight` and `jacobians`, for the price of one of them."""
        points = (_pairs(xy) - self.matrix[:2, 2]) @ self._inverse.T
        tolerance = _TOLERANCE_PX / max(self.matrix[0, 0], self.matrix[1, 1])
        sight, slopes = self._lens.sights(points, tolerance)
        unknown = np.isnan(sight).any(1)
        if unknown.any():
            sight[unknown] = slopes[unknown] = np.nan
        return sight, slopes @ self._inverse

    @np.errstate(all="ignore")
    def pixels(self, sight: ArrayLike) -> Array:
        """Return where directions appear, (N, 2) px, inside the image or not.

        Parameters
        ----------
        sight : (N, 3) float
            Optical frame, of any length.

        Returns
        -------
        (N, 2) float64
            NaN behind the camera, and where the distortion model has folded over.
        """
        points = self._lens.project(np.asarray(sight, float).reshape(-1, 3))
        pixels: Array = points @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        pixels[~np.isfinite(pixels).all(1)] = np.nan
        return pixels


def to_radec(sight: ArrayLike, attitude: Rotation) -> tuple[Array, Array]:
    """Return right ascension, (N,) rad in [0, 2 pi), and declination, (N,) rad.

    Parameters
    ----------
    sight : (N, 3) float
        Optical frame, of any length.
    attitude : Rotation
        Turns coordinates from ICRS to the optical frame.
    """
    x, y, z = (np.asarray(sight, float).reshape(-1, 3) @ attitude.as_matrix()).T
    ra = np.arctan2(y, x) % (2 * np.pi)
    # The remainder of a tiny negative angle rounds to the whole turn.
    return np.where(ra >= 2 * np.pi, 0.0, ra), np.arctan2(z, np.hypot(x, y))


def from_radec(ra: ArrayLike, dec: ArrayLike, attitude: Rotation) -> Array:
    """Return unit lines of sight, (N, 3), optical frame.

    Parameters
    ----------
    ra, dec : (N,) float
        rad, ICRS.
    attitude : Rotation
        Turns coordinates from ICRS to the optical frame.
    """
    ra, dec = np.broadcast_arrays(np.atleast_1d(ra), np.atleast_1d(dec))
    parts = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    turned: Array = np.stack(parts, -1) @ attitude.as_matrix().T
    return turned


def _pairs(values: ArrayLike) -> Array:
    return np.asarray(values, float).reshape(-1, 2)


def _check(width: int, height: int, matrix: Array, distortion: Array, model: str) -> None:
    """Raise a CameraError if the values are no calibration."""
    if matrix.shape != (3, 3):
        raise CameraError(f"a camera's matrix is 3 x 3, not {matrix.shape}")
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise CameraError("the calibration contains values that are not numbers")
    if matrix[0, 0] == 0:
        raise CameraError("the camera is not calibrated: K[0] is 0")
    if matrix[0, 0] < 0 or matrix[1, 1] <= 0:
        raise CameraError(f"focal lengths must be positive, not {matrix[0, 0]}, {matrix[1, 1]}")
    if matrix[1, 0] or matrix[2].tolist() != [0, 0, 1]:
        raise CameraError("a camera's matrix is [fx s cx; 0 fy cy; 0 0 1]")
    if width < 1 or height < 1:
        raise CameraError(f"an image of {width} x {height} px is empty")
    if model not in _COUNTS:
        known = ", ".join([*_COUNTS, "fisheye"])
        raise CameraError(f"unknown distortion model {model!r}; known are {known}")
    if distortion.size not in _COUNTS[model]:
        counts = " or ".join(str(count) for count in _COUNTS[model])
        raise CameraError(
            f"{model} has {counts} distortion coefficients, but there are {distortion.size}"
        )
    if distortion[12:].any():
        raise CameraError("a tilted sensor (coefficients 13 and 14) is not supported")


@lru_cache(maxsize=16)  # a camera's calibration comes again and again, mostly the same
@np.errstate(all="ignore")
def _lens_of(model: str, distortion: tuple[float, ...], extent: float) -> Lens:
    if model != "equidistant" and not any(distortion):
        return Pinhole()
    kind, count = (Fisheye, 4) if model == "equidistant" else (Brown, 12)
    coefficients = np.zeros(count)
    coefficients[: len(distortion)] = distortion[:count]
    try:
        return kind(coefficients, extent)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise CameraError(f"{model} {list(distortion)} is no distortion: {error}") from None
