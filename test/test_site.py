# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Azimuth and elevation: against the rotation written out, and without any network."""

import subprocess
import sys
from datetime import UTC, datetime

import erfa
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy.utils import iers

from ofsat_ros.site import Site, SiteError, azimuth_elevation

ARCSEC = np.radians(1 / 3600)
NS = 1_000_000_000
ZIMMERWALD = Site(46.8772, 7.4652, 951.0)
SITES = [ZIMMERWALD, Site(-33.9, 18.5, 10.0), Site(0.0, 260.0, 0.0), Site(89.9, -150.0, 2000.0)]


def stamp_of(*date):
    return int(datetime(*date, tzinfo=UTC).timestamp()) * NS


def sky(count=60):
    """Directions over the whole sky, the same number in each part of it."""
    random = np.random.default_rng(3)
    return random.uniform(0, 2 * np.pi, count), np.arcsin(random.uniform(-1, 1, count))


def separation(one, other):
    """Return the angle between directions (longitude, latitude), rad."""
    vectors = [
        np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
        for a, b in (one, other)
    ]
    return np.linalg.norm(vectors[0] - vectors[1], axis=0)


def written_out(ra, dec, julian_date, ut1_utc_s, pole_arcsec, site, tt_utc_s):
    """Aberration, the Earth's orientation and the site's axes, one after the other.

    Without light deflection, which is under 0.01" beyond 40 degrees from the Sun.
    """
    day, fraction = julian_date
    tt, ut1 = fraction + tt_utc_s / 86400, fraction + ut1_utc_s / 86400
    direction = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)
    to_earth = erfa.c2t06a(day, tt, day, ut1, *(np.array(pole_arcsec) * ARCSEC))
    # The observer's velocity in units of that of light: round the Sun, and with the ground.
    _, earth = erfa.epv00(day, tt)
    place = erfa.gd2gc(1, np.radians(site.longitude_deg), np.radians(site.latitude_deg), 0.0)
    ground = to_earth.T @ np.cross([0, 0, 7.292115e-5], place)
    velocity = earth["v"] * 149597870.7 / 86400 / 299792.458 + ground / 299792458.0
    # Special relativity's formula of aberration (Explanatory Supplement, 7.2.3).
    inverse_gamma = np.sqrt(1 - velocity @ velocity)
    along = direction @ velocity
    seen = inverse_gamma * direction + velocity * (1 + along / (1 + inverse_gamma))[:, None]
    seen /= (1 + along)[:, None]
    longitude, latitude = np.radians([site.longitude_deg, site.latitude_deg])
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)]
    up = np.array([*up, np.sin(latitude)])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0])
    parts = (seen @ to_earth.T) @ np.stack([east, np.cross(up, east), up]).T
    return np.arctan2(parts[:, 0], parts[:, 1]), np.arcsin(parts[:, 2])


@pytest.mark.parametrize("site", SITES, ids=str)
def test_agrees_with_the_rotation_written_out(site):
    # Of IERS Bulletin B: UT1-UTC and the pole on 2020 January 1, 0 h UTC.
    ut1_utc_s, pole_arcsec = -0.17716, (0.0766, 0.2823)
    stamp_ns, julian_date = stamp_of(2020, 1, 1), (2458849.5, 0.0)
    ra, dec = sky()
    sun = SkyCoord(280.5, -23.1, unit="deg")
    far = sun.separation(SkyCoord(ra, dec, unit="rad")).deg > 40
    ra, dec = ra[far], dec[far]
    expected = written_out(ra, dec, julian_date, ut1_utc_s, pole_arcsec, site, 37 + 32.184)
    found = azimuth_elevation(ra, dec, stamp_ns, site)
    assert separation(found, expected).max() < 0.015 * ARCSEC


def test_agrees_with_astropys_own_frames():
    """Which have the same tables and the same ERFA behind them, but came another way."""
    stamps = stamp_of(2024, 3, 1) + np.arange(60) * 4_321_000_000_123
    ra, dec = sky()
    found = azimuth_elevation(ra, dec, stamps, ZIMMERWALD)
    place = EarthLocation.from_geodetic(7.4652, 46.8772, 951.0)
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        time = Time(stamps // NS, stamps % NS / NS, format="unix")
        there = SkyCoord(ra, dec, unit="rad").transform_to(AltAz(obstime=time, location=place))
        theirs = there.az.rad, there.alt.rad
    assert separation(found, theirs).max() < 1e-4 * ARCSEC


def test_azimuth_runs_from_north_through_east():
    # Polaris, and where it is from Zimmerwald: north, as high as the pole.
    azimuth, elevation = azimuth_elevation(
        np.radians(37.95), np.radians(89.26), stamp_of(2024, 3, 1), ZIMMERWALD
    )
    assert np.degrees(elevation[0]) == pytest.approx(46.9, abs=0.8)
    assert np.cos(azimuth[0]) > 0.999
    # On the equator a star rises in the east and goes down in the west.
    equator, ra = Site(0.0, 0.0, 0.0), np.linspace(0, 2 * np.pi, 200, endpoint=False)
    azimuth, elevation = azimuth_elevation(ra, np.zeros(200), stamp_of(2024, 3, 1), equator)
    later = azimuth_elevation(ra, np.zeros(200), stamp_of(2024, 3, 1) + 60 * NS, equator)
    up = np.abs(elevation) < 1.4
    rising = (later[1] > elevation)[up]
    assert (np.sin(azimuth[up]) > 0).tolist() == rising.tolist()
    assert ((azimuth >= 0) & (azimuth < 2 * np.pi)).all()


def test_the_nanoseconds_count():
    """The sky turns by 15" in a second."""
    stamp_ns = stamp_of(2024, 3, 1)
    equator = Site(0.0, 0.0, 0.0)
    first, later = (
        azimuth_elevation(1.0, 0.0, stamp_ns + more, equator) for more in (0, 1_000_000)
    )
    moved = separation(first, later)[0] / ARCSEC
    assert moved == pytest.approx(0.01504, rel=1e-3)


def test_refraction_only_if_asked_for():
    ra, dec = sky(400)
    stamp_ns = stamp_of(2024, 3, 1)
    _, true = azimuth_elevation(ra, dec, stamp_ns, ZIMMERWALD)
    _, seen = azimuth_elevation(ra, dec, stamp_ns, ZIMMERWALD, pressure_hpa=1013.25, humidity=0.0)
    high = true > np.radians(15)
    # Smart, Spherical Astronomy, 37: of 10 degrees C and 760 mm, by the seen zenith distance.
    tangent = 1 / np.tan(seen[high])
    expected = 58.294 * tangent - 0.0668 * tangent**3
    np.testing.assert_allclose((seen - true)[high] / ARCSEC, expected, rtol=0.005, atol=0.1)
    assert ((seen - true)[high] > 0).all()


def test_what_is_unknown_stays_so():
    azimuth, elevation = azimuth_elevation([np.nan, 1.0], [0.1, 0.2], 0, ZIMMERWALD)
    assert np.isnan([azimuth[0], elevation[0]]).all()
    assert np.isfinite([azimuth[1], elevation[1]]).all()
    assert azimuth_elevation([], [], 0, ZIMMERWALD)[0].shape == (0,)


@pytest.mark.parametrize("year", [1965, 2090])
def test_dates_outside_the_tables_are_as_accurate_as_stated(year):
    """UT1-UTC is under 0.9 s by definition, the pole within 0.6" of its mean."""
    date = datetime(year, 6, 1, tzinfo=UTC)
    seconds = int(date.timestamp())
    ra, dec = sky()
    found = azimuth_elevation(ra, dec, seconds * NS, ZIMMERWALD)
    julian_date = (2440587.5 + seconds // 86400, 0.0)
    for ut1_utc_s in (-0.9, 0.9):
        expected = written_out(ra, dec, julian_date, ut1_utc_s, (0.0, 0.3), ZIMMERWALD, 69.184)
        assert separation(found, expected).max() < 30 * ARCSEC


OFFLINE = """
import socket

tried = []

def refuse(*args, **kwargs):
    tried.append(args)
    raise OSError("no network here")

socket.socket.connect = socket.socket.connect_ex = refuse
socket.getaddrinfo = socket.gethostbyname = refuse

from astropy.time import Time
from astropy.utils import iers
from ofsat_ros.site import Site, azimuth_elevation

# So late that all tables, that of leap seconds too, have expired long since.
iers.LeapSeconds._today = staticmethod(lambda: Time("2090-01-01", scale="tai"))
assert iers.conf.auto_download, "the test shows nothing if downloads are off anyway"
# From long ago to beyond all predictions: leap seconds and the Earth's rotation are asked for.
stamps = [year * 31_557_600 * 10**9 for year in (-10, 20, 50, 57, 60, 120)]
azimuth, _ = azimuth_elevation([1.0] * 6, [0.5] * 6, stamps, Site(47.0, 8.0, 400.0))
assert len(set(azimuth.tolist())) == 6
assert not tried, tried
assert iers.conf.auto_download and iers.conf.auto_max_age == 30, "settings are left as they were"
try:
    socket.create_connection(("198.51.100.1", 80), 1)
except OSError:
    pass
assert tried, "the test does not see attempts"
"""


def test_nothing_is_downloaded(tmp_path):
    """In a process of its own, with an empty cache, where nothing has been asked for before."""
    home = {
        "HOME": str(tmp_path),
        "XDG_CACHE_HOME": str(tmp_path),
        "XDG_CONFIG_HOME": str(tmp_path),
    }
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", OFFLINE],
        capture_output=True,
        text=True,
        timeout=60,
        env={**home, "PYTHONPATH": ":".join(sys.path), "PATH": ""},
    )
    assert done.returncode == 0, done.stderr


def test_without_astropy_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.time", None)
    with pytest.raises(ModuleNotFoundError, match=r"install the extra ofsat_ros\[sky\]") as caught:
        azimuth_elevation(1.0, 0.5, 0, ZIMMERWALD)
    assert caught.value.name == "astropy.time"


def test_a_site_from_text():
    assert Site.parse("46.8772, 7.4652, 951") == ZIMMERWALD
    assert Site.parse("-33.9,18.5,-10.5") == Site(-33.9, 18.5, -10.5)


@pytest.mark.parametrize(
    "text", ["", "46.9,7.5", "46.9 7.5 951", "46.9,7.5,951,3", "46N,7.5,951", "46,,951"]
)
def test_text_that_names_no_site(text):
    with pytest.raises(SiteError, match="LATITUDE,LONGITUDE,HEIGHT in degrees"):
        Site.parse(text)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((90.1, 0.0, 0.0), "latitude_deg must be within -90 to 90, not 90.1"),
        ((0.0, -181.0, 0.0), "longitude_deg must be within -180 to 360"),
        ((0.0, 361.0, 0.0), "longitude_deg must be within -180 to 360"),
        ((0.0, 0.0, 2e5), "height_m must be within -1000 to 100000"),
        ((0.0, 0.0, float("nan")), "height_m must be within"),
    ],
)
def test_sites_that_are_nowhere(values, words):
    with pytest.raises(SiteError, match=words):
        Site(*values)
    with pytest.raises(SiteError, match=words):
        Site.parse(",".join(str(value) for value in values))
