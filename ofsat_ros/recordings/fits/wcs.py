# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A FITS header's world coordinates as a camera and its attitude.

A camera of `ofsat_ros.camera` and a zenithal projection of the FITS standard (M. Calabretta, E.
Greisen, "Representations of celestial coordinates in FITS", 2002) are two ways to write the same:
the reference pixel is the principal point, CD is focal lengths, skew and roll, TAN an ideal lens,
and ARC an equiangular one.  What distorts further (SIP, TPV, SIN, ZEA, ...) is fitted to the
lens's own polynomials, and how well these follow it is found out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera, CameraError
from ofsat_ros.recordings.fits.warning import silence

Array = NDArray[np.float64]

_CARDS = re.compile(
    r"C(TYPE|RVAL|RPIX|DELT|UNIT|ROTA)[12]|(CD|PC)[12]_[12]|P[VS][12]_\d+|LONPOLE|LATPOLE"
    r"|RAD(E|EC)SYS|EQUINOX|EPOCH|[AB]_(ORDER|\d+_\d+)"
)
_TEXT = re.compile("CTYPE|CUNIT|RAD|EQUINOX|EPOCH|PS")
_LENSES = {
    **dict.fromkeys(("TAN", "TPV", "TNX"), "plumb_bob"),
    **dict.fromkeys(("ARC", "SIN", "STG", "ZEA", "ZPN"), "equidistant"),
}
# The camera is compared with the WCS at so many pixels along each side.
_GRID = 9
# What is not worth a distortion, what is worth a word, and what is no calibration any more, px.
_ALIKE_PX, _NOTED_PX, _USELESS_PX = 1e-3, 0.1, 2.0


class SkyMap:
    """The world coordinates of one image.

    Parameters
    ----------
    cards : Mapping
        The image's own header.

    Raises
    ------
    CameraError
        If they are no camera's, or make no sense.
    """

    def __init__(self, cards: Mapping[str, Any]) -> None:
        from astropy.io.fits import Header
        from astropy.wcs import WCS

        own = {name: cards[name] for name in cards if _CARDS.fullmatch(name) and name in cards}
        for name, value in own.items():  # the library takes text for 0
            if not (_TEXT.match(name) or isinstance(value, int | float)):
                raise CameraError(f"{name} is {value!r}, and not a number")
        for name in ("CTYPE1", "CTYPE2") if "A_ORDER" in own else ():
            own[name] = f"{own[name]}".removesuffix("-SIP") + "-SIP"  # or the library complains
        try:
            with silence():
                self._wcs = wcs = WCS(Header(own), fix=False, naxis=2)
                wcs.wcs.set()
            matrix, middle = np.array(wcs.pixel_scale_matrix), np.array(wcs.wcs.crpix) - 1
        # The library's own errors, those of the C library below it, and those of bad values.
        except Exception as error:
            raise CameraError(_words(error)) from error
        kind = str(wcs.wcs.ctype[wcs.wcs.lng])[5:8]
        if wcs.wcs.lng < 0 or kind not in _LENSES:
            raise CameraError(f"{own['CTYPE1']!r} is no projection that a camera has")
        self.model = _LENSES[kind]
        self._axes = [wcs.wcs.lng, wcs.wcs.lat]
        # From pixels to the native plane (x, y), and from there to (east, north).
        pole = np.radians(wcs.wcs.lonpole)
        turn = np.array([[-np.cos(pole), -np.sin(pole)], [np.sin(pole), -np.cos(pole)]])
        self._matrix = turn @ np.radians(matrix[self._axes])
        self._middle = middle
        size = np.linalg.det(self._matrix)
        if not (np.isfinite(self._matrix).all() and np.isfinite(middle).all() and size):
            raise CameraError("its pixel scale is zero, or no number")

    @property
    def is_mirrored(self) -> bool:
        """Whether the sky is mirrored if the first row is the top one."""
        return bool(np.linalg.det(self._matrix) < 0)

    @np.errstate(all="ignore")
    def camera(self, width: int, height: int, turned: bool) -> tuple[Camera, Rotation, str]:
        """Return the camera, the rotation from ICRS to its frame, and what to say of them.

        Parameters
        ----------
        width, height : int
            px.
        turned : bool
            Whether the first row has become the last one.

        Raises
        ------
        CameraError
            If no camera does what the header says.
        """
        if self.is_mirrored != turned:
            raise CameraError("it mirrors the sky, unlike that of the first image")
        flip = np.diag([1.0, -1.0 if turned else 1.0])
        middle = np.array([0.0, height - 1.0 if turned else 0.0]) + flip @ self._middle
        roll, upper = np.linalg.qr(self._matrix @ flip)
        signs = np.sign(np.diag(upper))
        roll, upper = roll * signs, signs[:, None] * upper
        k = np.eye(3)
        k[:2, :2], k[:2, 2] = np.linalg.inv(upper), middle
        attitude = Rotation.from_matrix(_axes_of(roll) @ self._tangent_frame())
        xy = _grid(width, height)
        file_xy = xy @ flip + (0.0, height - 1.0 if turned else 0.0)
        sky = self._directions(file_xy)
        seen = np.isfinite(sky).all(1)
        if seen.mean() < 0.5:
            raise CameraError("most of its pixels have no direction")
        camera = Camera.from_calibration(width, height, k.ravel(), [], self.model)
        if _miss(camera, attitude, xy[seen], sky[seen]) > _ALIKE_PX:
            camera, attitude = _fitted(camera, attitude, xy[seen], sky[seen])
        miss = _miss(camera, attitude, xy[seen], sky[seen])
        if not miss < _USELESS_PX:
            raise CameraError(f"no lens model follows its distortion: {miss:.2g} px off")
        words = f"its WCS is followed to within {miss:.2g} px" if miss > _NOTED_PX else ""
        return camera, attitude, words

    def _tangent_frame(self) -> Array:
        """Return east, north and outwards at the reference point as rows, (3, 3), ICRS."""
        lon, lat = np.radians(np.array(self._wcs.wcs.crval)[self._axes])
        east = [-np.sin(lon), np.cos(lon), 0.0]
        out = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
        own = np.array([east, np.cross(out, east), out])
        # Two frames of stars differ by a rotation, or (FK4) nearly so: by that of this place.
        near = own[2] + 0.01 * np.array([-own[0] - own[1], own[0] - own[1], own[1]])
        turn, _ = Rotation.align_vectors(self._to_icrs(near), near)
        return own @ turn.as_matrix().T

    def _to_icrs(self, vectors: Array) -> Array:
        """Return directions, (N, 3), of the header's frame in ICRS."""
        from astropy.coordinates import ICRS, SkyCoord
        from astropy.wcs.utils import wcs_to_celestial_frame

        try:
            frame = wcs_to_celestial_frame(self._wcs)
            if isinstance(frame, ICRS):
                return vectors / np.linalg.norm(vectors, axis=1)[:, None]
            place = SkyCoord(*vectors.T, frame=frame, representation_type="cartesian").icrs
            length = np.linalg.norm(place.cartesian.xyz.value, axis=0)
            return np.array(place.cartesian.xyz.value / length).T
        except Exception as error:  # as in __init__
            raise CameraError(f"its coordinates cannot be turned to ICRS: {error}") from error

    def _directions(self, xy: Array) -> Array:
        """Return where pixels of the file look, (N, 3), ICRS; NaN where nothing is."""
        try:
            lon, lat = np.radians(self._wcs.all_pix2world(xy, 0)[:, self._axes].T)
        except Exception as error:  # as in __init__
            raise CameraError(_words(error)) from error
        own = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
        sky = np.full(own.shape, np.nan)
        known = np.isfinite(own).all(1)
        sky[known] = self._to_icrs(own[known])
        return sky


def _words(error: Exception) -> str:
    """Return an error's last line: the C library puts its own places before it."""
    return f"{error}".strip().rpartition("\n")[2].rstrip(".") or type(error).__name__


def _axes_of(roll: Array) -> Array:
    """Return the optical axes as rows in (east, north, outwards)."""
    axes = np.eye(3)
    axes[:2, :2] = roll.T
    return axes


def _grid(width: int, height: int) -> Array:
    columns, rows = np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID)
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)


def _miss(camera: Camera, attitude: Rotation, xy: Array, sky: Array) -> float:
    """Return by how much the camera's directions are off at most, px; infinite if unknown."""
    off = np.linalg.norm(attitude.inv().apply(camera.lines_of_sight(xy)) - sky, axis=1)
    return float(np.nan_to_num(off, nan=np.inf).max() * np.sqrt(np.linalg.det(camera.matrix)))


def _fitted(camera: Camera, attitude: Rotation, xy: Array, sky: Array) -> tuple[Camera, Rotation]:
    """Return a camera with distortion, and its attitude, that see directions at pixels."""
    from scipy.optimize import least_squares

    fisheye = camera.model == "equidistant"
    # Of Brown's model, the prism's terms stand at the end; a telescope needs no rational ones.
    size, free = (4, range(4)) if fisheye else (12, (0, 1, 2, 3, 4, 8, 9, 10, 11))
    k = camera.matrix

    directions = attitude.apply(sky)[:, None]
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints

    def of(values: Array) -> tuple[Array, Array]:
        matrix, coefficients = np.array(k), np.zeros(size)
        matrix[0, :2] += values[3:5] * k[0, 0]
        matrix[1, 1] += values[5] * k[1, 1]
        coefficients[list(free)] = values[6:]
        return matrix, coefficients

    def missed(values: Array) -> Array:
        matrix, coefficients = of(values)
        points, _ = project(directions, values[:3], np.zeros(3), np.eye(3), coefficients)
        off = points.reshape(-1, 2) @ matrix[:2, :2].T + matrix[:2, 2] - xy
        return np.asarray(off.ravel())

    start = np.zeros(6 + len(free))
    try:
        best = least_squares(missed, start, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12)
        matrix, coefficients = of(best.x)
        model = "equidistant" if fisheye else "rational_polynomial"
        fitted = Camera(camera.width, camera.height, matrix, coefficients, model)
    except (ValueError, np.linalg.LinAlgError, cv2.error) as error:
        raise CameraError(f"no lens model follows its distortion: {error}") from error
    return fitted, Rotation.from_rotvec(best.x[:3]) * attitude


def sky_map(cards: Mapping[str, Any]) -> SkyMap | None:
    """Return the world coordinates of a header; None if it has none; raises as `SkyMap`."""
    names = [str(cards.get(f"CTYPE{i}", "")).upper() for i in (1, 2)]
    on_sky = all(re.match(r"(RA|DEC|.LON|.LAT|..L[NT])-", name) for name in names)
    return SkyMap(cards) if on_sky and "CRVAL1" in cards else None
