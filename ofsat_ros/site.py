# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Where the camera stands on the Earth, and the azimuth and elevation of what it sees.

Outside the flow of the stages: who writes results asks here.  Right ascension and declination, as
`camera` states them, are a place among the catalogue's stars; so the way to the horizon is that of
a star, and leads to where it is seen from the site at that moment: precession, nutation, the
Earth's rotation and polar motion, annual and diurnal aberration and the Sun's light deflection are
in (IAU 2006/2000A, ERFA's atco13); refraction only if a pressure is given.  A direction that does
not come from a catalogue's stars has not lost the annual aberration, and would get it twice (20").

Nothing is downloaded: the Earth's rotation is that of the tables that astropy brings along.
Where they are measured, azimuth and elevation are right to 0.01"; where they predict, to about
0.5" a year ahead.  Outside them the nearest known day's values are taken, which are wrong by up to
1.8 s in UT1-UTC (27" along the equator) and 1" in the place of the pole.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_NS = 1_000_000_000
_RANGES = {
    "latitude_deg": (-90.0, 90.0),
    "longitude_deg": (-180.0, 360.0),
    "height_m": (-1000.0, 100_000.0),
}


class SiteError(ValueError):
    """A site that is not on the Earth, or text that names none."""


@dataclass(frozen=True)
class Site:
    """A place on the Earth, WGS 84.

    Attributes
    ----------
    latitude_deg : float
        Geodetic, north positive.
    longitude_deg : float
        East positive, -180 to 360.
    height_m : float
        Above the ellipsoid.

    Raises
    ------
    SiteError
        If a value is out of its range.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise SiteError(f"{name} must be within {low:g} to {high:g}, not {value!r}")

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``LATITUDE,LONGITUDE,HEIGHT``: degrees, degrees, metres.

        Raises
        ------
        SiteError
            If the text is anything else.
        """
        try:
            latitude, longitude, height = (float(part) for part in text.split(","))
        except ValueError:
            raise SiteError(
                "a site is LATITUDE,LONGITUDE,HEIGHT in degrees (north and east positive) and"
                f" metres, as 47.3,8.55,420, not {text!r}"
            ) from None
        return cls(latitude, longitude, height)


def azimuth_elevation(
    ra: ArrayLike,
    dec: ArrayLike,
    stamp_ns: int | ArrayLike,
    site: Site,
    *,
    pressure_hpa: float = 0.0,
    temperature_c: float = 10.0,
    humidity: float = 0.5,
    wavelength_um: float = 0.55,
) -> tuple[Array, Array]:
    """Return azimuth and elevation at which places among the stars are seen from a site.

    Parameters
    ----------
    ra, dec : (N,) float
        ICRS, rad.
    stamp_ns : int or (N,) int
        When, ns UTC.
    site : Site
    pressure_hpa, temperature_c, humidity, wavelength_um : float
        Of the air at the site (humidity 0 to 1) and of the light, for the refraction; pressure 0:
        no refraction.  ERFA's model is good to 1" above 15 degrees of elevation.

    Returns
    -------
    azimuth : (N,) float64
        From north through east, rad, in [0, 2 pi).
    elevation : (N,) float64
        rad.

    Raises
    ------
    ModuleNotFoundError
        If astropy is not installed.
    """
    ra, dec, stamps = np.broadcast_arrays(
        np.atleast_1d(np.asarray(ra, float)), dec, np.asarray(stamp_ns, np.int64)
    )
    try:
        import erfa
        from astropy.time import Time
        from astropy.utils import iers
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "azimuth and elevation need astropy: install the extra ofsat_ros[sky], or apt's"
            f" python3-astropy ({error})",
            name=error.name,
        ) from error
    if not ra.size:  # of which older astropy's tables cannot tell
        return np.zeros(ra.shape), np.zeros(ra.shape)
    with (
        warnings.catch_warnings(),
        np.errstate(invalid="ignore"),  # NaN of unknown directions
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("auto_max_age", None),
    ):
        # Of years so far ahead that leap seconds are not known yet.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        time = Time(stamps // _NS, (stamps % _NS) / _NS, format="unix", scale="utc")
        ut1_utc, x_pole, y_pole = _earth_rotation(time, iers.earth_orientation_table.get())
        azimuth, zenith_distance, *_ = erfa.atco13(
            ra,
            dec,
            *(0.0, 0.0, 0.0, 0.0),  # no proper motion, parallax, radial velocity
            *(time.jd1, time.jd2, ut1_utc),
            *(np.radians(site.longitude_deg), np.radians(site.latitude_deg), site.height_m),
            *(x_pole, y_pole),
            *(pressure_hpa, temperature_c, humidity, wavelength_um),
        )
    return azimuth, np.pi / 2 - zenith_distance


def _earth_rotation(time: Any, table: Any) -> tuple[Array, Array, Array]:
    """Return UT1-UTC (s) and the pole's x and y (rad), each (N,), of the nearest known days."""
    # With the status asked for, astropy raises and warns of nothing outside the table.
    ut1_utc, _ = table.ut1_utc(time, return_status=True)
    x_pole, y_pole, _ = table.pm_xy(time, return_status=True)
    return ut1_utc.to_value("s"), x_pole.to_value("rad"), y_pole.to_value("rad")
