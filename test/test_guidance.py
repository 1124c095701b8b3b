# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide against a toy plant: a mount, a target and perfect tracks, without images."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.guidance import Command, Guide
from ofsat_ros.parameters import GuideParameters
from ofsat_ros.simulation.mount import SimulatedMount
from ofsat_ros.tracking import COASTING, TRACK_DTYPE

ARCSEC = np.radians(1 / 3600)
PIXEL = 10 * ARCSEC
CAMERA = Camera.ideal(512, 512, PIXEL)
CENTRE = 255.5
SEEN = 1
NS = 1_000_000_000
START_NS = 1_767_225_600 * NS


def track(track_id: int = 1, xy=(CENTRE, CENTRE), rel=(0.0, 0.0), v=None, **columns) -> np.void:
    row = np.zeros(1, TRACK_DTYPE)[0]
    row["track_id"], row["status"], row["flux"] = track_id, SEEN, 1000.0
    row["x"], row["y"] = xy
    row["rel_vx"], row["rel_vy"] = rel
    row["vx"], row["vy"] = rel if v is None else v
    row["sigma_vx"] = row["sigma_vy"] = 0.5
    row["sight"] = (0.0, 0.0, 1.0)
    for name, value in columns.items():
        row[name] = value
    return row


def rows(*tracks: np.void) -> np.ndarray:
    return np.array(list(tracks), TRACK_DTYPE)


def ns(seconds: float) -> int:
    return START_NS + round(seconds * NS)


def update_after_a_pause(guide: Guide, seconds: float, tracks: np.ndarray) -> None:
    """The first frame after a pause tells only that there was one."""
    for before_s in (0.05, 0):
        guide.update(ns(seconds - before_s), tracks, CAMERA)


@dataclass
class Plant:
    """A camera on a mount, and a target that `azimuth_deg(t)` along the equator says.

    Frames every 0.1 s, their tracks `late_s` after the middle of the exposure; commands at 20 Hz.
    """

    azimuth_deg: Callable[[float], float]
    guide: Guide
    start_px: tuple[float, float] = (0.0, 0.0)
    late_s: float = 0.085
    latency_s: float = 0.0
    gain: float = 1.0
    mount_args: dict = field(default_factory=dict)
    seen: Callable[[float, np.ndarray], np.ndarray | None] | None = None

    def __post_init__(self) -> None:
        # Boresight along x of ICRS, right towards y, down towards z.
        base = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
        x, y = np.array(self.start_px) * PIXEL
        start = Rotation.from_rotvec([-y, x, 0]) * base
        self.mount = SimulatedMount(start, latency_s=self.latency_s, **self.mount_args)

    def direction(self, t: float) -> np.ndarray:
        azimuth = np.radians(self.azimuth_deg(t))
        return np.array([np.cos(azimuth), np.sin(azimuth), 0.0])

    def run(self, seconds: float) -> Iterator[tuple[float, np.ndarray, Command]]:
        """Yield time, true offset (right, down) in px, and command, at every command."""
        waiting: list[tuple[float, int, np.ndarray | None]] = []
        before = None
        for tick in range(round(seconds * 20)):
            t = tick / 20
            attitude = self.mount.attitudes(np.array([t]))[0]
            xy = CAMERA.pixels(attitude.apply(self.direction(t))[None])[0]
            if tick % 2 == 0:
                ahead, behind = (attitude.apply(self.direction(t + d)) for d in (1e-3, -1e-3))
                rel = np.subtract(*CAMERA.pixels([ahead, behind])) / 2e-3
                v = (xy - before) / 0.1 if before is not None else rel
                before = xy
                row = rows(track(1, xy, rel, v))
                waiting.append((t + self.late_s, ns(t), row))
            while waiting and waiting[0][0] <= t:
                _, stamp, row = waiting.pop(0)
                if self.seen is not None:
                    row = self.seen((stamp - START_NS) / NS, row)
                if row is not None:
                    self.guide.update(stamp, row, CAMERA)
            command = self.guide.command(ns(t))
            if command.commanding:
                self.mount.command(t, self.gain * command.mount_rate)
            yield t, xy - CENTRE, command


def engaged(**given) -> Guide:
    return Guide(GuideParameters(engaged=True, **given))


def errors_px(plant: Plant, seconds: float, after_s: float) -> np.ndarray:
    """True offsets after settling, px, (N,)."""
    return np.array([np.hypot(*off) for t, off, _ in plant.run(seconds) if t >= after_s])


# Signs


@pytest.mark.parametrize(
    ("px", "omega"), [((80, 0), (0, 1, 0)), ((0, 80), (-1, 0, 0)), ((-60, 60), (-1, -1, 0))]
)
def test_mount_is_turned_towards_the_target(px, omega):
    guide = engaged(max_acceleration_deg_s2=100)
    guide.update(ns(0), rows(track(xy=np.add(CENTRE, px))), CAMERA)
    guide.command(ns(0))
    command = guide.command(ns(0.05))
    np.testing.assert_allclose(command.offset, np.array(px) * PIXEL, rtol=1e-3)
    # As an angular velocity about +y (down) turns the boresight to +x (right), about +x to -y.
    np.testing.assert_array_equal(np.sign(np.round(command.mount_rate, 9)), omega)
    # With the default settling time of 1 s, the rate is the offset per second.
    assert np.hypot(*command.mount_rate[:2]) == pytest.approx(np.hypot(*px) * PIXEL, rel=1e-3)


def test_motion_against_the_stars_is_fed_forward():
    guide = engaged(max_acceleration_deg_s2=100, integral_s=0)
    guide.update(ns(0), rows(track(rel=(72.0, -36.0))), CAMERA)
    guide.command(ns(0))
    command = guide.command(ns(0.01))
    focal = 1 / PIXEL
    # Contract: w = (-rel_v / f, rel_u / f, 0); the rest brings in what the target has gone since.
    np.testing.assert_allclose(command.mount_rate[:2] * focal, (36, 72), rtol=0.02)
    assert command.mount_rate[2] == 0


def test_offset_and_rate_are_those_of_now():
    guide = Guide()
    # Rate tracking by another: it stands in the image, 40 px to the right, and the stars move.
    guide.update(ns(0), rows(track(xy=(CENTRE + 40, CENTRE), rel=(72, 0), v=(5, 0))), CAMERA)
    command = guide.command(ns(0.2))
    np.testing.assert_allclose(command.offset / PIXEL, (41, 0), atol=0.01)
    np.testing.assert_allclose(command.rate / PIXEL, (5, 0), atol=0.01)
    assert not command.commanding
    assert not command.mount_rate.any()


# The loop


def drift(rate_deg_s: float) -> Callable[[float], float]:
    return lambda t: rate_deg_s * t


def test_drifting_target_is_brought_to_the_boresight_and_kept():
    plant = Plant(drift(0.2), engaged(), start_px=(-60, 40))
    off = errors_px(plant, 12, 8)
    assert np.sqrt(np.mean(off**2)) < 0.1  # perfect measurements: what is left is the model's


def test_there_is_no_overshoot():
    plant = Plant(drift(0.0), engaged(), start_px=(60, -40))
    along = [(off @ (60, -40)) / np.hypot(60, 40) for _, off, _ in plant.run(10)]
    assert along[0] == pytest.approx(72, abs=0.2)
    assert min(along) > -1.0  # px, of 72


def test_large_offset_is_braked_in_time():
    # 1 deg at 0.2 deg/s^2: a proportional rate would overshoot by a third.
    limits = {"max_acceleration_deg_s2": 0.2}
    plant = Plant(drift(0.0), engaged(**limits), start_px=(360, 0), mount_args=limits)
    off = [off[0] for _, off, _ in plant.run(15)]
    assert off[0] == pytest.approx(360, abs=1)
    assert min(off) > -2
    assert abs(off[-1]) < 0.5


def leo_deg(t: float) -> float:
    """Azimuth in a pass whose rate rises from 0.2 to 0.6 deg/s in 28 s, and falls."""
    u = (t - 28) / 20.1
    return 0.6 * 20.1 * (np.arctan(u) - np.arctan(-28 / 20.1))


def test_pass_with_rising_and_falling_rate():
    off = errors_px(Plant(leo_deg, engaged(), start_px=(50, 50)), 50, 8)
    # The rate changes by up to 0.02 deg/s^2, 7 px/s^2: without the acceleration, 0.7 px were left.
    assert off.max() < 0.4


def test_known_latency_of_the_mount_is_predicted():
    def late(told_s):
        plant = Plant(leo_deg, engaged(mount_latency_s=told_s, settling_s=0.5), latency_s=0.3)
        return errors_px(plant, 40, 10).max()

    assert late(0.3) < 0.5 * late(0.0)
    assert late(0.3) < 0.5


@pytest.mark.parametrize("latency_s", [0.1, 0.3, 0.6])
def test_stable_with_a_latency_nobody_told(latency_s):
    plant = Plant(drift(0.2), engaged(), start_px=(60, -40), latency_s=latency_s)
    along = np.array([(off @ (60, -40)) / np.hypot(60, 40) for _, off, _ in plant.run(20)])
    assert np.abs(along[-100:]).max() < 1.0
    # It comes from up to 90 px away: the usual latencies hardly make it overshoot.
    assert along.min() > {0.1: -0.5, 0.3: -5.0, 0.6: -40.0}[latency_s]


@pytest.mark.parametrize("gain", [0.7, 1.4])
def test_mount_of_another_gain_is_learned(gain):
    # 30 % of 0.2 deg/s is 21 px/s, which the integral makes up for.
    plant = Plant(drift(0.2), engaged(), start_px=(-60, 40), gain=gain)
    assert errors_px(plant, 40, 30).max() < 1.0


def test_periodic_error_is_followed():
    plant = Plant(drift(0.2), engaged(), mount_args={"periodic_error": (20.0, 60.0)})
    # 20 arcsec at 2 pi / 60 s is 2.1 arcsec/s; settling in 1 s leaves 0.2 px of it.
    assert errors_px(plant, 35, 10).max() < 0.3


# Limits


def test_rate_and_its_change_are_limited_with_the_direction_kept():
    given = {"max_rate_deg_s": 0.1, "max_acceleration_deg_s2": 0.05}
    guide = engaged(**given)
    plant = Plant(drift(0.0), guide, start_px=(-300, -200))
    rates = np.array([c.mount_rate for _, _, c in plant.run(20)])
    speeds = np.degrees(np.linalg.norm(rates, axis=1))
    changes = np.degrees(np.linalg.norm(np.diff(rates, axis=0), axis=1)) * 20
    assert 0.099 < speeds.max() <= 0.1 + 1e-9
    assert 0.049 < changes.max() <= 0.05 + 1e-9
    fast = rates[speeds > 0.05]
    np.testing.assert_allclose(fast[:, 0] / fast[:, 1], -200 / 300, rtol=0.02)


def test_lowered_limit_of_the_rate_holds_at_once():
    guide, command = following()
    guide.parameters = guide.parameters.replace(max_rate_deg_s=0.05)
    lowered = guide.command(ns(1.05)).mount_rate
    assert np.degrees(np.linalg.norm(lowered)) == pytest.approx(0.05, rel=1e-9)
    assert lowered @ command.mount_rate > 0
    guide.engage(False)
    guide.parameters = guide.parameters.replace(max_rate_deg_s=0.01)
    assert np.degrees(np.linalg.norm(guide.command(ns(1.05)).mount_rate)) <= 0.01 + 1e-9


def test_limited_rate_winds_nothing_up():
    # Six times faster than the mount may go, then still.
    azimuth = lambda t: 0.6 * min(t, 5.0)  # noqa: E731
    plant = Plant(azimuth, engaged(max_rate_deg_s=0.1, stale_after_s=10), latency_s=0.0)
    wound, off = 0.0, []
    for t, offset, command in plant.run(45):
        wound = max(wound, np.hypot(*command.integral) if t < 5 else 0.0)
        off.append(offset[0])
    assert wound < 1e-6
    assert max(off) > 500
    assert min(off) > -3  # px


# The dead-man


def following(**given) -> tuple[Guide, Command]:
    """A guide that follows at 0.2 deg/s, at 1 s; nothing comes after that."""
    guide = engaged(**given)
    for tick in range(21):
        if tick % 2 == 0:
            guide.update(ns(tick / 20), rows(track(rel=(72, 0), v=(0, 0))), CAMERA)
        command = guide.command(ns(tick / 20))
    assert command.state == "following"
    assert np.degrees(command.mount_rate[1]) == pytest.approx(0.2, rel=0.01)
    return guide, command


def speeds(guide: Guide, start_s: float, end_s: float, each=lambda t: None) -> dict[float, float]:
    """Commanded speeds, deg/s, by time."""
    found = {}
    for tick in range(round(start_s * 20) + 1, round(end_s * 20) + 1):
        each(tick / 20)
        rate = guide.command(ns(tick / 20)).mount_rate
        assert np.isfinite(rate).all()
        found[tick / 20] = float(np.degrees(np.linalg.norm(rate)))
    return found


def is_still_after(found: dict[float, float], seconds: float) -> bool:
    return all(speed == 0 for t, speed in found.items() if t > seconds)


def test_rate_decays_when_tracks_cease():
    guide, _ = following(stale_after_s=1.0, decay_s=0.5)
    found = speeds(guide, 1, 4)
    assert found[1.95] == pytest.approx(0.2, rel=0.05)
    assert found[2.25] == pytest.approx(0.1, rel=0.15)
    assert is_still_after(found, 1 + 1.0 + 0.5 + 0.05)
    command = guide.command(ns(4.05))
    assert command.state == "dead-man"
    assert "track 1 was not seen for 3.0 s" in command.reason
    assert np.isnan(command.offset).all()
    assert np.isnan(command.rate).all()


def test_decay_keeps_to_the_acceleration():
    guide, _ = following(stale_after_s=1.0, decay_s=0.1, max_acceleration_deg_s2=0.5)
    found = speeds(guide, 1, 4)
    values = list(found.values())
    assert max(a - b for a, b in pairwise(values)) <= 0.5 / 20 + 1e-9
    # 0.2 deg/s at 0.5 deg/s^2 takes longer than the decay's 0.1 s.
    assert is_still_after(found, 1 + 1.0 + 0.4 + 0.1)


def test_what_is_nan_does_not_keep_alive():
    guide, _ = following(stale_after_s=1.0)

    def broken(t):
        guide.update(ns(t), rows(track(xy=(np.nan, CENTRE), rel=(72, 0))), CAMERA)

    found = speeds(guide, 1, 4, broken)
    assert is_still_after(found, 2.6)
    # It was followed for 1 s, and so waited for as long.
    assert "track 1 was lost 1.1 s ago" in guide.command(ns(4.05)).reason


@pytest.mark.parametrize(
    "columns",
    [
        {"rel_vx": 1e160},
        {"rel_vy": -1e308, "rel_vx": 1e308},
        {"rel_vx": np.inf},
        {"rel_vx": 3e5},  # 14 rad/s
        {"x": 1e300},
        {"y": -600.0},
        {"sight": np.nan},
    ],
)
@pytest.mark.parametrize("on", [True, False])
def test_what_cannot_be_is_no_target(columns, on):
    guide = Guide(GuideParameters(engaged=on))
    for tick in range(3):
        guide.update(ns(tick / 10), rows(track(**{"v": (0, 0)} | columns)), CAMERA)
        command = guide.command(ns(tick / 10))
        assert command.target_id == 0
        assert not command.mount_rate.any()


def test_velocity_in_the_image_that_cannot_be_is_not_the_mounts():
    guide = Guide()
    guide.update(ns(0), rows(track(rel=(72, 0), v=(1e200, 1e308))), CAMERA)
    guide.engage(True)
    assert np.isfinite(guide.command(ns(0)).mount_rate).all()
    command = guide.command(ns(0.1))
    assert command.state == "following"
    assert np.degrees(np.linalg.norm(command.mount_rate)) <= 0.1 + 1e-9


def test_no_finite_input_makes_the_command_infinite():
    rng = np.random.default_rng(7)
    guide, t = engaged(reacquire_s=0.5), 0.0
    numbers = ("x", "y", "vx", "vy", "rel_vx", "rel_vy")
    for _ in range(600):
        t += rng.choice([1e-9, 0.05, 0.1, 3.0, -0.2], p=[0.1, 0.4, 0.4, 0.05, 0.05])
        wild = {name: rng.normal() * 10.0 ** rng.integers(-3, 7) for name in numbers}
        number = int(rng.integers(1, 3))
        status = int(rng.choice([SEEN, COASTING]))
        guide.update(ns(t), rows(track(number, status=status, **wild)), CAMERA)
        command = guide.command(ns(t + 0.05))
        assert np.isfinite(command.mount_rate).all()
        assert np.degrees(np.linalg.norm(command.mount_rate)) <= 3.0 + 1e-9
    assert is_still_after(speeds(guide, t + 0.05, t + 9), t + 2 + 4)


def test_coasting_is_followed_for_a_while_but_does_not_keep_alive():
    guide, _ = following(stale_after_s=1.0, reacquire_s=60)

    def coast(t):
        xy = (CENTRE + 10, CENTRE)
        guide.update(ns(t), rows(track(1, xy, (72, 0), (0, 0), status=COASTING)), CAMERA)

    found = speeds(guide, 1, 1.5, coast)
    command = guide.command(ns(1.55))
    assert command.state == "coasting"
    # What the detector expects is better than our own dead reckoning.
    assert command.offset[0] / PIXEL == pytest.approx(10, abs=2)
    np.testing.assert_allclose(command.integral, 0, atol=1e-15)
    assert min(found.values()) > 0.19
    assert is_still_after(speeds(guide, 1.55, 4, coast), 2.6)


def test_coasting_track_that_goes_astray_is_not_followed():
    # As when the star field of one frame is misjudged.
    guide, _ = following(stale_after_s=1.0)
    astray = track(1, (CENTRE - 36, CENTRE + 18), (72, 0), (0, 0), status=COASTING)
    guide.update(ns(1.1), rows(astray), CAMERA)
    command = guide.command(ns(1.15))
    assert command.state == "lost"
    np.testing.assert_allclose(command.offset / PIXEL, 0, atol=1)
    again = track(2, (CENTRE + 1, CENTRE), (71, 0), (0, 0))
    guide.update(ns(1.2), rows(astray, again), CAMERA)
    command = guide.command(ns(1.25))
    assert command.state == "following"
    assert command.target_id == 2


def test_time_running_backwards_ends_what_is_followed():
    guide, _ = following()
    command = guide.command(ns(-100))
    assert command.state == "searching"
    assert "ran backwards by 101 s" in command.reason
    assert is_still_after(speeds(guide, -100, -97), -99.4)
    update_after_a_pause(guide, -97, rows(track(rel=(72, 0))))
    assert guide.command(ns(-96.95)).state == "following"


@pytest.mark.parametrize("ahead_s", [-30.0, 30.0])
def test_stamps_of_another_clock_are_not_followed(ahead_s):
    guide = engaged()
    for tick in range(20):
        guide.update(ns(ahead_s + tick / 20), rows(track(rel=(72, 0))), CAMERA)
        command = guide.command(ns(tick / 20))
    assert command.state == "dead-man"
    assert ("ahead of the clock" in command.reason) == (ahead_s > 0)
    assert not command.mount_rate.any()


def test_hiccup_of_the_caller_is_no_leave_to_jump():
    guide, _ = following(stale_after_s=30.0)
    guide.update(ns(10), rows(track(xy=(CENTRE + 200, CENTRE), rel=(-500, 0))), CAMERA)
    rate = guide.command(ns(10.1)).mount_rate
    # At most half a second's worth of 1 deg/s^2.
    assert np.degrees(np.linalg.norm(rate)) <= 0.2 + 0.5 + 1e-9


def test_disengaged_comes_to_rest_and_falls_silent():
    guide, _ = following()
    guide.engage(False)
    sent = []
    for tick in range(21, 81):
        guide.update(ns(tick / 20), rows(track(rel=(72, 0), v=(0, 0))), CAMERA)
        command = guide.command(ns(tick / 20))
        assert command.state == "disengaged"
        assert np.isfinite(command.offset).all()
        sent.append((tick / 20, command.commanding, np.degrees(command.mount_rate[1])))
    moving = [t for t, commanding, rate in sent if commanding and rate]
    zeros = [t for t, commanding, rate in sent if commanding and not rate]
    silent = [t for t, commanding, _ in sent if not commanding]
    assert max(moving) <= 1.5
    assert max(zeros) - min(zeros) == pytest.approx(1.0, abs=0.051)
    assert min(silent) == pytest.approx(max(zeros) + 0.05)
    assert not any(rate for _, commanding, rate in sent if not commanding)


def test_engaged_takes_over_at_the_mounts_own_rate():
    guide = Guide()
    # Somebody else tracks at 0.2 deg/s: the target stands in the image.
    for tick in range(3):
        guide.update(ns(tick / 10), rows(track(rel=(72, 0), v=(0, 0))), CAMERA)
        guide.command(ns(tick / 10))
    guide.engage(True)
    command = guide.command(ns(0.25))
    assert command.commanding
    assert np.degrees(command.mount_rate[1]) == pytest.approx(0.2, rel=0.01)


def test_without_calibration_nothing_moves():
    guide = engaged()
    guide.update(ns(0), rows(track(rel=(72, 0))), None)
    command = guide.command(ns(0.1))
    assert command.state == "waiting for camera_info"
    assert not command.mount_rate.any()
    assert np.isnan(command.offset).all()


# Which target

THREE = rows(
    track(4, (300, 300), flux=10.0),
    track(7, (100, 100), flux=np.nan),
    track(9, (200, 100), flux=99.0),
)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({}, 4),
        ({"target": "brightest"}, 9),
        ({"target": "nearest"}, 4),
        ({"target": "id", "target_id": 7}, 7),
        ({"target": "id", "target_id": 8}, 0),
    ],
)
def test_target_is_chosen(given, wanted):
    guide = Guide(GuideParameters(**given))
    guide.update(ns(0), THREE[::-1], CAMERA)
    command = guide.command(ns(0))
    assert command.target_id == wanted
    if not wanted:
        assert "track 8 is not there" in command.reason


@pytest.mark.parametrize("given", [{}, {"target": "nearest"}, {"target": "id", "target_id": 4}])
def test_what_is_only_expected_is_not_chosen(given):
    guide = Guide(GuideParameters(**given))
    guide.update(ns(0), rows(track(4, status=COASTING)), CAMERA)
    assert guide.command(ns(0)).target_id == 0
    guide.update(ns(0.1), rows(track(4)), CAMERA)
    assert guide.command(ns(0.1)).target_id == 4


def test_target_is_kept_though_another_becomes_better():
    guide = Guide(GuideParameters(target="brightest"))
    guide.update(ns(0), THREE, CAMERA)
    later = THREE.copy()
    later["flux"] = [1000, 1000, 1]
    guide.update(ns(0.1), later, CAMERA)
    assert guide.command(ns(0.1)).target_id == 9


def test_target_is_changed_while_running():
    guide = Guide()
    guide.update(ns(0), THREE, CAMERA)
    assert guide.command(ns(0)).target_id == 4
    guide.parameters = guide.parameters.replace(target="id", target_id=9)
    assert guide.command(ns(0.05)).target_id == 9
    guide.parameters = guide.parameters.replace(target="nearest")
    assert guide.command(ns(0.1)).target_id == 4
    guide.parameters = guide.parameters.replace(settling_s=0.8)
    assert guide.command(ns(0.15)).target_id == 4


# After a gap


def lost(seconds: float = 2.0, **given) -> Guide:
    """A guide that followed track 1, right at 50 px/s, and lost it at CENTRE + 100."""
    guide = Guide(GuideParameters(**given))
    for tick in range(round(seconds * 10) + 1):
        t = tick / 10
        path = track(1, (CENTRE + 50 * t, CENTRE), (50, 0))
        guide.update(ns(t), rows(path, track(2, (30, 30), (0.1, 0))), CAMERA)
    return guide


def test_same_object_is_found_again_after_a_gap():
    guide = lost()
    for tick in range(21, 31):
        guide.update(ns(tick / 10), rows(), CAMERA)
    assert "lost: track 1 was seen 1.0 s ago" in guide.command(ns(3)).reason
    path = (CENTRE + 50 * 3.1 + 8, CENTRE - 6)
    new = rows(track(3, (100, 100), (50, 0)), track(5, path, (45, 4)))
    guide.update(ns(3.1), new, CAMERA)
    command = guide.command(ns(3.1))
    assert command.target_id == 5
    assert "re-acquired, was 1" in command.reason


@pytest.mark.parametrize(
    "other",
    [
        track(3, (CENTRE + 155 + 40, CENTRE), (50, 0)),  # beside the path
        track(3, (CENTRE + 155, CENTRE), (-50, 0)),  # the other way
        track(2, (CENTRE + 155, CENTRE), (50, 0)),  # was there when it was lost
        track(3, (CENTRE + 155, CENTRE), (50, 0), status=COASTING),
    ],
)
def test_another_object_is_not_taken_for_the_lost_one(other):
    guide = lost()
    guide.update(ns(2.1), rows(), CAMERA)
    guide.update(ns(3.1), rows(other), CAMERA)
    assert guide.command(ns(3.1)).state == "disengaged"
    assert "lost: track 1" in guide.command(ns(3.1)).reason


def test_own_motion_counts_in_the_search():
    # Another drives the camera along with it: it stands in the image, and so it does when it is
    # back, 3 s and 150 px of sky later.
    guide = Guide()
    for tick in range(21):
        guide.update(ns(tick / 10), rows(track(1, (300, 200), (50, 0), (0, 0))), CAMERA)
    guide.update(ns(2.1), rows(), CAMERA)
    update_after_a_pause(guide, 5.0, rows(track(3, (303, 201), (52, 0), (0, 0))))
    assert guide.command(ns(5.0)).target_id == 3


def test_own_commands_count_in_the_search():
    guide, _ = following(stale_after_s=0.5, decay_s=0.0, reacquire_s=20.0)
    guide.update(ns(1.1), rows(), CAMERA)
    before = speeds(guide, 1, 5)
    # The mount went on and then stopped; the target did not.
    gone = 72 * (5.0 - 1.0) - sum(before.values()) / 20 / np.degrees(PIXEL)
    assert 200 < gone < 255
    update_after_a_pause(guide, 5.0, rows(track(8, (CENTRE + gone + 5, CENTRE), (70, 0))))
    assert guide.command(ns(5.05)).target_id == 8


def test_new_choice_is_made_when_the_wait_is_over():
    guide = lost(reacquire_s=1.5)
    other = rows(track(2, (30, 30), (0.1, 0)))
    guide.update(ns(3.4), other, CAMERA)
    assert guide.command(ns(3.4)).target_id == 1
    guide.update(ns(3.6), other, CAMERA)
    assert guide.command(ns(3.6)).target_id == 2


def test_what_was_followed_for_a_moment_is_waited_for_a_moment():
    guide = lost(seconds=0.3, reacquire_s=60.0)
    guide.update(ns(1.2), rows(), CAMERA)
    assert guide.command(ns(1.2)).target_id == 1
    guide.update(ns(1.4), rows(), CAMERA)
    assert guide.command(ns(1.4)).target_id == 0
    assert "track 1 was lost 1.1 s ago; there is no track" in guide.command(ns(1.4)).reason


def test_detector_that_began_anew_is_noticed():
    guide = lost()
    guide.update(ns(2.1), rows(), CAMERA)
    # Its numbers begin at 1 again: not the same object, though the same number.
    guide.update(ns(2.2), rows(track(1, (30, 400), (3, 3))), CAMERA)
    assert "lost" in guide.command(ns(2.2)).reason


@pytest.mark.parametrize(("gap_s", "same"), [(1.5, True), (2.5, False)])
def test_same_number_after_silence_is_not_the_same_object(gap_s, same):
    # No cloud tells of the gap: after a long one the detector may have begun anew.
    guide = lost(seconds=4.0)
    elsewhere = rows(track(1, (CENTRE, CENTRE - 150), (3, 3)))
    update_after_a_pause(guide, 4 + gap_s, elsewhere)
    assert ("lost" in guide.command(ns(4 + gap_s)).reason) != same


def test_same_number_on_its_path_after_silence_is_followed_on():
    guide = lost(seconds=4.0)
    update_after_a_pause(guide, 7, rows(track(1, (CENTRE + 350 + 9, CENTRE), (50, 0))))
    assert "following: track 1, " in guide.command(ns(7)).reason
