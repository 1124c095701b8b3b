# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""An orbit comes back out of rendered images, and an error of the time does not pass."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from sgp4.api import Satrec

from benchmarks.orbit import main
from benchmarks.orbit.angles import ARCSEC, Angles, read_tdm
from benchmarks.orbit.fitting import Elements, compare, fit
from benchmarks.orbit.geometry import Geometry, find_pass
from benchmarks.orbit.report import TLES
from ofsat_ros.site import Site

SITE = Site(47.0, 8.0, 500.0)
# The first pass of Ajisai there: 2022-09-21 03:26:33 UTC.
START_NS, SECONDS = 1_663_730_793_000_000_000, 450.0


def rows(told: str) -> dict[str, list[str]]:
    """Cells of all rows of a text's tables, by the first one."""
    found = {}
    for line in told.splitlines():
        if line.startswith("| "):
            name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
            found.setdefault(name, cells)
    return found


def column(told: str, case: str, name: str, nth: int = 0) -> float:
    head = rows(told)["case"]
    return float(rows(told)[case][[i for i, each in enumerate(head) if each == name][nth]])


def test_an_orbit_comes_back(capsys: pytest.CaptureFixture[str]):
    # Streaks of 4 px; those of 8 px are of test_refinement.
    code = main(["--quick", "--jobs", "1", "--stare-exposure-s", "0.05"])
    told = capsys.readouterr().out
    for case in ("Ajisai, tracking", "Ajisai, stares"):
        assert rows(told)[case][:2] == ["24", "24"]  # frames, angles
        assert column(told, case, "of others") == 0
        # The targets; with 24 angles of 0.1 px a mean scatters by 0.02 px.
        assert abs(column(told, case, "px", 0)) < 0.1
        assert abs(column(told, case, "px", 1)) < 0.1
        assert 0.5 < column(told, case, "rms / stated along") < 1.5
        # A sixth of a pixel at most: 8" each.
        assert column(told, case, 'rms along, "') < 1.4
    # 0.2 deg/s: 1 ms is 0.7", of which the mean of 24 tells a third.
    assert abs(column(told, "Ajisai, stares", "along as time, ms")) < 0.75
    axis = rows(told)["semi-major axis, km"]
    assert float(axis[0]) == pytest.approx(7866, abs=1)
    assert abs(float(axis[1])) < 4 * float(axis[2]) < 4  # km; in stds
    assert (code, told.splitlines()[-1]) == (0, "All targets are met.")


def test_late_stamps_do_not_pass(capsys: pytest.CaptureFixture[str]):
    code = main(["--quick", "--jobs", "1", "--stamp-error-ms", "10"])
    told = capsys.readouterr().out
    # What a camera that stands still sees is said to be seen later; one that follows the satellite
    # sees it where its attitude, whose clock is right, was at the later time.
    time_ms = column(told, "Ajisai, stares", "along as time, ms")
    assert time_ms == pytest.approx(-10, abs=2)
    assert abs(column(told, "Ajisai, tracking", "px")) < 0.1
    assert code == 1
    assert "Ajisai, stares: the bias is over 0.1 px" in told


@pytest.fixture(scope="module")
def geometry() -> Geometry:
    return Geometry(SITE, START_NS, SECONDS)


def noisy_angles(geometry: Geometry, satellite: Satrec, sigma: float, seed: int) -> Angles:
    times_s = np.linspace(5, SECONDS - 5, 60)
    x, y, z = geometry.directions(satellite, times_s).T
    ra, dec = np.arctan2(y, x), np.arcsin(z)
    noise = np.random.default_rng(seed).normal(0, sigma, (60, 2))
    radec = np.stack([ra, dec], 1) + noise / np.stack([np.cos(dec), np.ones(60)], 1)
    stamps = START_NS + np.round(times_s * 1e9).astype(np.int64)
    return Angles(stamps, radec, np.full((60, 2), sigma), np.ones(60, int))


def test_the_pass_is_the_published_one():
    assert find_pass(TLES["Ajisai"], SITE) == (START_NS, SECONDS)


def test_covariance_of_a_fit_is_that_of_its_errors(geometry: Geometry):
    satellite = Satrec.twoline2rv(*TLES["Ajisai"])
    elements = Elements(satellite, geometry, SECONDS / 2)
    distances = []
    for seed in range(8):
        angles = noisy_angles(geometry, satellite, ARCSEC, seed)
        found = fit(angles, geometry, elements)
        assert found.used.all()
        distances.append(compare(found, elements, geometry, SECONDS / 2)[1])
    # Chi square of 6 has the mean 6 and the std 3.5: of eight, 1.2.
    assert np.mean(distances) == pytest.approx(6, abs=4)


def test_outliers_do_not_move_a_fit(geometry: Geometry):
    satellite = Satrec.twoline2rv(*TLES["Ajisai"])
    elements = Elements(satellite, geometry, SECONDS / 2)
    angles = noisy_angles(geometry, satellite, ARCSEC, 1)
    angles.radec[[3, 30, 50]] += 60 * ARCSEC
    found = fit(angles, geometry, elements)
    assert np.flatnonzero(~found.used).tolist() == [3, 30, 50]
    assert compare(found, elements, geometry, SECONDS / 2)[1] < 22.5  # of 999 in 1000


def test_directions_are_of_light_that_was_under_way(geometry: Geometry):
    satellite = Satrec.twoline2rv(*TLES["Ajisai"])
    times_s = np.array([SECONDS / 2])
    range_km = np.linalg.norm(geometry.orbit(satellite, times_s)[0] - geometry.site(times_s))
    left_s = times_s - range_km / 299_792.458
    way = geometry.orbit(satellite, left_s)[0] - geometry.site(times_s)
    sight = geometry.directions(satellite, times_s)
    # 6 ms at 0.2 deg/s are 4.5"; of the rest, nothing is left.
    assert math.acos(min(1.0, float(sight[0] @ way[0]) / np.linalg.norm(way))) < 1e-7
    assert 1600 < range_km < 2100


def test_a_message_is_read_as_it_is_written(tmp_path: Path):
    file = tmp_path / "one.tdm"
    file.write_text(
        "META_START\nMETA_STOP\nDATA_START\n"
        "COMMENT SIGMA rms 0.5000 0.6000\n"
        "COMMENT SIGMA 2022-09-21T03:26:33.100000 0.5000 0.6000\n"
        "ANGLE_1 = 2022-09-21T03:26:33.100000 350.00000000\n"
        "ANGLE_2 = 2022-09-21T03:26:33.100000 -10.50000000\nDATA_STOP\n",
        encoding="ascii",
    )
    angles = read_tdm(file)
    assert angles.stamps_ns.tolist() == [START_NS + 100_000_000]
    assert np.degrees(angles.radec).tolist() == [pytest.approx([350, -10.5])]
    assert (angles.sigma / ARCSEC).tolist() == [pytest.approx([0.5, 0.6])]


def test_what_is_no_satellite_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "nothing.txt"
    file.write_text("1 16908U\n")
    with pytest.raises(SystemExit, match=re.escape("2")):
        main(["--tle", f"{file}"])
    assert "must end with the two lines of a satellite's elements" in capsys.readouterr().err
