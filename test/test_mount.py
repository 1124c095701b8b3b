# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The simulated mount: it does what it is told, within its limits, and stops when told no more."""

import math

import numpy as np
import pytest

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation import Fixed, SimulatedMount, looking_at

START = looking_at(1.0, 0.4, 0.2)
DEG, ARCSEC = math.radians(1), math.radians(1 / 3600)
QUICK = {"max_rate_deg_s": 5, "max_acceleration_deg_s2": 1e4, "timeout_s": 100}


def rates(mount: SimulatedMount, times_s: np.ndarray) -> np.ndarray:
    """Angular rates, (N - 1, 3) rad/s in the optical frame, in the mean between the times."""
    attitudes = mount.attitudes(times_s)
    turns = (attitudes[1:] * attitudes[:-1].inv()).as_rotvec()
    return -turns / np.diff(times_s)[:, None]


def test_without_commands_it_tracks_the_stars():
    mount = SimulatedMount(START)
    np.testing.assert_allclose(rates(mount, np.arange(5.0)), 0, atol=1e-15)
    np.testing.assert_allclose(mount.attitudes([9.0])[0].as_matrix(), START.as_matrix())


def test_a_fixed_camera_keeps_its_attitude():
    found = Fixed(START).attitudes(np.arange(3.0))
    assert len(found) == 3
    np.testing.assert_allclose(found.as_matrix(), [START.as_matrix()] * 3, atol=1e-15)


@pytest.mark.parametrize(
    ("axis", "seen"),
    # Where the boresight goes, in the optical frame of before: x right, y down.
    [((0, 1, 0), (1, 0)), ((1, 0, 0), (0, -1)), ((0, 0, 1), (0, 0))],
)
def test_signs_of_the_rate(axis, seen):
    mount = SimulatedMount(START, **QUICK)
    mount.command(0.0, 1e-4 * np.array(axis))
    later = mount.attitudes([10.0])[0]
    boresight = START.apply(later.inv().apply([0, 0, 1]))
    # 1 mrad, less the 2e-7 s of acceleration.
    np.testing.assert_allclose(boresight[:2], 1e-3 * np.array(seen), atol=1e-9)
    # About the boresight the field turns against the camera.
    x_axis = later.apply(START.inv().apply([1, 0, 0]))
    assert x_axis[1] == pytest.approx(-1e-3 * axis[2], abs=1e-9)


def test_it_moves_at_the_commanded_rate_until_the_next_command():
    mount = SimulatedMount(START, **QUICK)
    first, second = np.array([1e-3, 2e-3, 0.5e-3]), np.array([-2e-3, 0, 0])
    assert mount.command(1.0, first) == ""
    assert mount.command(3.0, second) == ""
    found = rates(mount, np.arange(0.0, 5.5, 0.5))
    # At 1e4 deg/s^2 a change of 3e-3 rad/s takes 2e-5 s.
    expected = np.array([np.zeros(3)] * 2 + [first] * 4 + [second] * 4)
    np.testing.assert_allclose(found, expected, atol=2e-7)


def test_the_rate_is_limited_and_keeps_its_direction():
    mount = SimulatedMount(START, **{**QUICK, "max_rate_deg_s": 0.5})
    mount.command(0.0, np.array([3, -4, 0]) * DEG)
    np.testing.assert_allclose(
        rates(mount, np.array([1.0, 2.0])), [[0.3 * DEG, -0.4 * DEG, 0]], atol=1e-12
    )


def test_the_acceleration_is_limited():
    mount = SimulatedMount(START, max_acceleration_deg_s2=0.5, timeout_s=100)
    mount.command(0.0, [0, 1.0 * DEG, 0])
    mount.command(4.0, [0, -1.0 * DEG, 0])
    times = np.arange(0.0, 10.01, 0.1)
    found = rates(mount, times) / DEG
    middle = (times[1:] + times[:-1]) / 2
    # Up within 2 s, down again through zero within 4 s.
    expected = np.interp(middle, [0, 2, 4, 8, 10], [0, 1, 1, -1, -1])
    np.testing.assert_allclose(found[:, 1], expected, atol=1e-9)
    np.testing.assert_allclose(found[:, [0, 2]], 0, atol=1e-12)


def test_a_change_of_direction_goes_straight_at_the_same_acceleration():
    mount = SimulatedMount(START, max_acceleration_deg_s2=1.0, timeout_s=100)
    mount.command(0.0, [0.3 * DEG, 0, 0])
    mount.command(2.0, [0, 0.4 * DEG, 0])  # 0.5 deg/s away: 0.5 s
    times = 2.0 + np.arange(0, 0.61, 0.05)
    found = rates(mount, times) / DEG
    share = np.minimum(((times[1:] + times[:-1]) / 2 - 2) / 0.5, 1)
    np.testing.assert_allclose(found[:, 0], 0.3 * (1 - share), atol=1e-5)
    np.testing.assert_allclose(found[:, 1], 0.4 * share, atol=1e-5)


def test_a_command_takes_effect_a_latency_later():
    mount = SimulatedMount(START, **QUICK, latency_s=0.3)
    mount.command(1.0, [1e-3, 0, 0])
    mount.command(1.2, [2e-3, 0, 0])  # on its way at the same time
    found = rates(mount, np.array([0.0, 1.29, 1.3, 1.49, 1.5, 1.7]))
    np.testing.assert_allclose(found[:, 0] * 1e3, [0, 0, 1, 1, 2], atol=1e-3)


@pytest.mark.parametrize("latency_s", [0.0, 0.2])
def test_it_stops_by_itself_when_the_last_command_is_old(latency_s):
    limits = {"max_acceleration_deg_s2": 2, "timeout_s": 0.5, "latency_s": latency_s}
    mount = SimulatedMount(START, **limits)
    for time_s in np.arange(0, 2, 0.25):
        mount.command(time_s, [0, 1.0 * DEG, 0])
    late = 1.75 + 0.5 + latency_s  # the last one was at 1.75 s
    times = np.array([1.0, late, late + 0.25, late + 0.5, late + 100])
    found = rates(mount, times)[:, 1] / DEG
    np.testing.assert_allclose(found, [1, 0.75, 0.25, 0], atol=1e-9)
    # And it takes up again.
    mount.command(late + 100, [0, 1.0 * DEG, 0])
    (again,) = rates(mount, late + 100 + latency_s + np.array([0, 0.5]))
    assert again[1] == pytest.approx(0.5 * DEG, rel=1e-9)  # in the mean, up to 1 deg/s


def test_the_periodic_error_has_its_amplitude_and_period():
    mount = SimulatedMount(START, periodic_error=(20, 8))
    times = np.arange(0, 24, 0.5)
    turns = (mount.attitudes(times) * START.inv()).as_rotvec()
    expected = -20 * ARCSEC * np.sin(2 * np.pi * times / 8)
    np.testing.assert_allclose(turns[:, 1], expected, atol=1e-12)
    np.testing.assert_allclose(turns[:, [0, 2]], 0, atol=1e-12)
    steady = rates(mount, np.array([24.0, 24.001]))
    assert steady[0, 1] == pytest.approx(20 * ARCSEC * 2 * np.pi / 8, rel=1e-6)


def test_it_comes_to_the_same_however_often_one_looks():
    def told() -> SimulatedMount:
        mount = SimulatedMount(START, max_acceleration_deg_s2=1.0, latency_s=0.013)
        mount.command(0.1, [1 * DEG, 2 * DEG, 0.3 * DEG])
        mount.command(0.9, [-1 * DEG, 1 * DEG, 0])
        return mount

    often = told().attitudes(np.linspace(0, 2.5, 777))[-1]
    again = told().attitudes(np.linspace(0, 2.5, 777))[-1]
    seldom = told().attitudes([2.5])[0]
    assert np.array_equal(often.as_quat(), again.as_quat())
    # 2.5 s at up to 0.001 arcsec/s.
    assert (often * seldom.inv()).magnitude() < 0.0025 * ARCSEC


@pytest.mark.parametrize("bad", [[math.nan, 0, 0], [0, math.inf, 0], [1, 2], None, 3.0])
def test_a_command_that_is_no_rate_stops_it_and_is_said(bad):
    mount = SimulatedMount(START, **QUICK)
    mount.command(0.0, [0, 1e-3, 0])
    assert "not three finite numbers: it stops" in mount.command(1.0, bad)
    found = rates(mount, np.array([0.5, 1.0, 1.1, 2.0]))
    np.testing.assert_allclose(found[:, 1] * 1e3, [1, 0, 0], atol=0.01)


def test_time_does_not_go_back():
    mount = SimulatedMount(START, latency_s=0.5)
    mount.command(1.0, np.zeros(3))
    assert mount.time_s == 1.0
    with pytest.raises(ParameterError, match=r"a command of 0.9 s .* the mount is at 1 s"):
        mount.command(0.9, np.zeros(3))
    mount.attitudes([2.0, 2.0])
    assert mount.time_s == 2.0
    for bad in (1.9, math.nan, math.inf):
        with pytest.raises(ParameterError, match="the mount is at 2 s"):
            mount.command(bad, np.zeros(3))
    for times in ([1.9], [2.5, 2.4], [math.nan]):
        with pytest.raises(ParameterError, match="the mount is at 2 s and does not go back"):
            mount.attitudes(times)
    mount.command(2.0, np.zeros(3))  # that is not too late


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"max_rate_deg_s": 0}, "max_rate_deg_s must be a number within"),
        ({"max_acceleration_deg_s2": math.nan}, "max_acceleration_deg_s2 must be a number"),
        ({"latency_s": -1}, "latency_s must be a number within 0 to 60, not -1"),
        ({"timeout_s": 0}, "timeout_s must be a number"),
        ({"periodic_error": 3}, "periodic_error must be a pair of numbers"),
        ({"periodic_error": (3, 0)}, "periodic_error must have a period over 0 s"),
    ],
)
def test_bad_limits_are_refused(bad, message):
    with pytest.raises(ParameterError, match=message):
        SimulatedMount(START, **bad)
