# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The simulator: what it renders is what its settings and its truth say."""

import dataclasses
import itertools
import math

import cv2
import numpy as np
import pytest

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation import (
    RSO,
    SCENARIOS,
    STAR_DTYPE,
    TRUTH_DTYPE,
    SimulatorSettings,
    SkySimulator,
    scenario,
    write_truth,
)

HEADER = "stamp_ns,frame,id,x_px,y_px,vx_px_s,vy_px_s,snr,flux,length_px"
DARK = {"width": 64, "height": 64, "star_count": 0, "noise_mean_percent": 0}
NOISELESS = {**DARK, "noise_std_percent": 0}


def simulate(**settings):
    return SkySimulator(SimulatorSettings(**settings))


def centroid(image, x, y, half=6):
    """Centre of light of the square around (x, y)."""
    column, row = round(x), round(y)
    rows, columns = np.mgrid[row - half : row + half + 1, column - half : column + half + 1]
    light = image[rows, columns].astype(float)
    return np.sum(columns * light) / light.sum(), np.sum(rows * light) / light.sum()


def matched_stars(before, after):
    """Rows of the stars that both tables hold; a star is known by its flux."""
    _, first, second = np.intersect1d(before["flux"], after["flux"], return_indices=True)
    return before[first], after[second]


def places(table):
    return np.stack([table["x_px"], table["y_px"]], axis=-1)


# --- light ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5])
def test_flux_is_conserved_at_any_phase_of_the_pixel(sigma, phase):
    rso = RSO((30 + phase, 31 - phase), (0, 0), 80)
    frame = simulate(rsos=(rso,), psf_sigma_px=sigma, **NOISELESS).frame()
    assert frame.truth["flux"] == pytest.approx(0.8 * 65535)
    # Rounding, 0.29 DN rms in each of up to 31 x 31 pixels: 9 DN rms.
    assert frame.image.sum(dtype=float) == pytest.approx(0.8 * 65535, abs=36)


def test_pixels_hold_the_gaussian_integrated_over_their_area():
    frame = simulate(rsos=(RSO((30.3, 28.8), (0, 0), 300),), psf_sigma_px=0.8, **NOISELESS).frame()
    # Midpoint rule with 400 points a pixel: wrong by 3e-7, under 0.03 DN.
    fine = (np.arange(64 * 400) + 0.5) / 400 - 0.5
    across = np.exp(-((fine - 30.3) ** 2) / (2 * 0.8**2)).reshape(64, 400).mean(axis=1)
    down = np.exp(-((fine - 28.8) ** 2) / (2 * 0.8**2)).reshape(64, 400).mean(axis=1)
    expected = 3 * 65535 * np.outer(down, across) / (2 * np.pi * 0.8**2)
    assert expected.max() < 65535
    assert np.abs(frame.image - expected).max() < 0.6  # half a DN of rounding


def test_centroids_of_isolated_stars_are_the_truth():
    settings = {**NOISELESS, "width": 400, "height": 300, "star_count": 40}
    frame = simulate(star_flux_percent=(20, 300), **settings).frame()
    stars = frame.stars
    measured = 0
    for star in stars:
        others = np.hypot(stars["x_px"] - star["x_px"], stars["y_px"] - star["y_px"])
        if np.sort(others)[1] < 20 or not (10 < star["x_px"] < 389 and 10 < star["y_px"] < 289):
            continue
        x, y = centroid(frame.image, star["x_px"], star["y_px"])
        assert (x, y) == pytest.approx((star["x_px"], star["y_px"]), abs=0.01)
        measured += 1
    assert measured >= 15


def test_a_moving_rso_leaves_a_streak_of_its_length_and_direction():
    # (6, 8) px/s for 2 s: 20 px at atan2(8, 6); the middle of the streak is the truth.
    settings = {**NOISELESS, "exposure_s": 2.0, "period_s": 3.0, "subsamples": 40}
    frame = simulate(rsos=(RSO((20, 15), (30, 40), 400),), **settings).frame()
    (truth,) = frame.truth
    assert (truth["x_px"], truth["y_px"]) == pytest.approx((26, 23))
    assert (truth["vx_px_s"], truth["vy_px_s"]) == pytest.approx((6, 8))
    assert truth["length_px"] == pytest.approx(20)
    light = frame.image.astype(float) / frame.image.sum(dtype=float)
    rows, columns = np.mgrid[:64, :64]
    mean = np.array([np.sum(columns * light), np.sum(rows * light)])
    assert mean == pytest.approx([26, 23], abs=0.01)
    offsets = np.stack([columns - mean[0], rows - mean[1]]).reshape(2, -1)
    variances, axes = np.linalg.eigh((offsets * light.reshape(-1)) @ offsets.T)
    # Of the PSF, of the pixel, and of 40 even points on 20 px.
    across = 1 + 1 / 12
    assert variances[0] == pytest.approx(across, abs=0.01)
    assert variances[1] == pytest.approx(across + 20**2 / 12 * (1 - 1 / 40**2), abs=0.05)
    assert abs(axes[:, 1] @ [0.6, 0.8]) == pytest.approx(1, abs=1e-5)


def test_the_streaks_light_is_spread_over_the_subsamples():
    # Two instants 16 px apart at the quarters of the exposure: two points of half the flux.
    settings = {**NOISELESS, "subsamples": 2}
    frame = simulate(rsos=(RSO((12, 30), (160, 0), 200),), **settings).frame()
    halves = frame.image[:, :28].sum(dtype=float), frame.image[:, 28:].sum(dtype=float)
    assert halves == pytest.approx((65535, 65535), abs=15)
    assert frame.image[30].argmax() in (20, 36)
    assert frame.image[:, 28].max() == 0


# --- motion -----------------------------------------------------------------------------------


def test_velocities_are_rates_minus_the_cameras_rate_over_the_pixel_scale():
    sky = {"pixel_scale_arcsec": 2.5, "camera_rate_arcsec_s": (15, -5), "star_count": 100}
    settings = {"exposure_s": 0.5, "period_s": 2.0, "rsos": (RSO((90, 80), (10, -15), 100),)}
    simulator = simulate(width=200, height=160, **sky, **settings)
    first, second = simulator.frame(), simulator.frame()
    assert np.allclose(first.stars["vx_px_s"], -6)
    assert np.allclose(first.stars["vy_px_s"], 2)
    assert (first.truth["vx_px_s"][0], first.truth["vy_px_s"][0]) == pytest.approx((-2, -4))
    before, after = matched_stars(first.stars, second.stars)
    assert len(before) > 70
    assert np.allclose(places(after) - places(before), (-12, 4))
    assert np.allclose(after["dx_px"], -12)
    assert np.allclose(after["dy_px"], 4)
    assert second.displacement_px == pytest.approx([-12, 4])
    assert second.rotation_rad == 0
    assert np.isnan(first.displacement_px).all()
    assert math.isnan(first.rotation_rad)
    assert np.isnan(first.stars["dx_px"]).all()


def test_what_moves_at_the_cameras_rate_stands_still():
    rate = (14.81, 2.61)
    simulator = simulate(camera_rate_arcsec_s=rate, rsos=(RSO((30.25, 20.5), rate, 100),))
    truth = np.concatenate([simulator.frame().truth for _ in range(5)])
    assert np.allclose(places(truth), (30.25, 20.5), atol=1e-9)
    assert np.all(truth["vx_px_s"] == 0)
    assert np.all(truth["length_px"] == 0)


def test_a_new_camera_rate_holds_from_the_next_exposure():
    simulator = simulate(camera_rate_arcsec_s=(10, 0), exposure_s=1, period_s=4, star_count=500)
    simulator.frame()
    assert simulator.pointing_arcsec == pytest.approx((40, 0))
    simulator.camera_rate_arcsec_s = (0, 20)
    frame = simulator.frame()
    # Mid-exposure to mid-exposure: 3.5 s at 2 px/s along x, then 0.5 s at 4 px/s along y.
    assert frame.displacement_px == pytest.approx([-7, -2])
    assert np.allclose(frame.stars["vy_px_s"], -4)
    assert simulator.camera_rate_arcsec_s == (0, 20)
    assert simulator.pointing_arcsec == pytest.approx((40, 80))


def test_the_field_turns_about_the_images_centre_from_x_to_y():
    turn = {"field_rotation_rad_s": 0.02, "exposure_s": 1.0, "period_s": 5.0}
    simulator = simulate(width=301, height=201, star_count=200, **turn)
    first, second = simulator.frame(), simulator.frame()
    before, after = matched_stars(first.stars, second.stars)
    assert len(before) > 120
    assert second.rotation_rad == pytest.approx(0.1)
    c, s = math.cos(0.1), math.sin(0.1)
    centre = np.array([150, 100])
    turned = (places(before) - centre) @ np.array([[c, s], [-s, c]]) + centre
    assert np.allclose(places(after), turned)
    # +x goes to +y: a star right of the centre moves down.
    assert np.allclose(after["vy_px_s"], 0.02 * (after["x_px"] - 150))
    assert np.allclose(after["vx_px_s"], -0.02 * (after["y_px"] - 100))
    assert second.displacement_px == pytest.approx([0, 0])


def test_rotation_shows_in_the_image():
    still_on_the_sky = RSO((50, 32), (0, 0), 100)
    settings = {**NOISELESS, "width": 65, "height": 65, "field_rotation_rad_s": math.pi / 2}
    simulator = simulate(rsos=(still_on_the_sky,), exposure_s=1e-4, **settings)
    simulator.frame()
    frame = simulator.frame()  # a quarter turn on: from right of the centre to below it
    assert centroid(frame.image, 32, 50) == pytest.approx((32, 50), abs=0.01)


def test_velocity_is_the_derivative_of_position_when_everything_moves():
    settings = {"field_rotation_rad_s": 0.3, "camera_rate_arcsec_s": (40, -25), "period_s": 1e-4}
    simulator = simulate(
        exposure_s=1e-4, rsos=(RSO((300, 200), (-30, 60), 100),), star_count=400, **settings
    )
    before, now, after = simulator.frame(), simulator.frame(), simulator.frame()
    speed = (places(after.truth) - places(before.truth)) / 2e-4
    assert speed[0] == pytest.approx([now.truth["vx_px_s"][0], now.truth["vy_px_s"][0]], abs=1e-4)
    # Central against one-sided difference: half a period at up to 30 px/s^2 of acceleration.
    assert np.allclose(after.stars["dx_px"] / 1e-4, after.stars["vx_px_s"], atol=0.01)
    central = np.abs(places(after.stars) - 255.5).max(axis=1) < 15
    displacement = np.stack([after.stars["dx_px"], after.stars["dy_px"]], axis=-1)[central]
    turning = places(after.stars)[central] - 255.5
    turning = 0.3 * 1e-4 * np.stack([-turning[:, 1], turning[:, 0]], axis=-1)
    assert len(turning) > 0
    assert np.allclose(displacement - turning, after.displacement_px, atol=1e-7)


def test_displacement_is_that_of_the_star_now_at_the_centre():
    # Half a radian and 20 px between frames, so that "then" and "now" differ plainly.
    settings = {"field_rotation_rad_s": 0.5, "camera_rate_arcsec_s": (100, 30)}
    simulator = simulate(exposure_s=0.1, period_s=1.0, **settings)
    simulator.frame()
    frame = simulator.frame()
    stars = frame.stars[np.isfinite(frame.stars["dx_px"])]
    c, s = math.cos(frame.rotation_rad), math.sin(frame.rotation_rad)
    offset = places(stars) - 255.5
    turned_back = offset @ np.array([[c, -s], [s, c]])
    step = np.stack([stars["dx_px"], stars["dy_px"]], axis=-1)
    assert np.allclose(step - (offset - turned_back), frame.displacement_px, atol=1e-9)
    assert np.hypot(*frame.displacement_px) > 15


# --- camera and attitude ----------------------------------------------------------------------


def test_the_camera_is_ideal():
    camera = simulate(width=301, height=200, pixel_scale_arcsec=5).camera
    assert (camera.width, camera.height) == (301, 200)
    focal_px = 1 / math.radians(5 / 3600)
    np.testing.assert_allclose(camera.matrix, [[focal_px, 0, 150], [0, focal_px, 99.5], [0, 0, 1]])


def test_attitude_without_motion_has_north_up_and_east_left():
    attitude = simulate(**DARK).frame().attitude
    # To the vernal equinox, east of it, and to the north pole.
    np.testing.assert_allclose(
        attitude.apply(np.eye(3)), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12
    )


def test_the_attitude_is_that_of_mid_exposure():
    turning = {"field_rotation_rad_s": 0.2, "exposure_s": 2.0, "period_s": 3.0, "jitter_std_px": 5}
    simulator = simulate(camera_rate_arcsec_s=(30, -40), **turning, **DARK)
    first, second = simulator.frame(), simulator.frame()
    # The field angle turns x towards y: at 0.2 and 0.8 rad.
    for frame, angle in ((first, 0.2), (second, 0.8)):
        x_axis = frame.attitude.apply([0, -1, 0])  # west, from where x was to the right
        np.testing.assert_allclose(x_axis, [math.cos(angle), math.sin(angle), 0], atol=1e-3)
    # And the boresight is where the plane's origin was at the start, 50 arcsec/s away in 1 s.
    west, south = first.attitude.inv().apply([0, 0, 1])[1:] * -1
    turned = np.exp(-0.1j) * complex(30, -40) * np.sinc(0.1 / np.pi)
    expected = np.radians([turned.real / 3600, turned.imag / 3600])
    assert (west, south) == pytest.approx(expected, rel=1e-6)


def test_stars_move_in_the_image_as_the_attitude_says():
    simulator = scenario("geo", 7)
    first, *others = (simulator.frame() for _ in range(4))
    star = first.attitude.inv().apply([[0, 0, 1]])
    (pixel,) = simulator.camera.pixels(others[-1].attitude.apply(star))
    expected = sum(frame.displacement_px for frame in others)
    # The simulated sky is flat: over these 100 arcsec that is below 1e-3 px.
    np.testing.assert_allclose(pixel - 255.5, expected, atol=1e-3)


def test_velocity_against_the_stars_is_the_rsos_own():
    settings = {"pixel_scale_arcsec": 2.5, "camera_rate_arcsec_s": (15, -5), "period_s": 2.0}
    settings |= {"width": 200, "height": 160, "star_count": 0, "field_rotation_rad_s": 0.05}
    rsos = (RSO((90, 80), (10, -15), 100), RSO((900, 80), (1, 2), 9), RSO((30, 9), (0, 0), 50))
    simulator = simulate(rsos=rsos, **settings)
    for angle in (0.025, 0.125):  # of the field, in mid-exposure
        frame = simulator.frame()
        c, s = math.cos(angle), math.sin(angle)
        own = np.array([[4, -6], [0, 0]]) @ np.array([[c, s], [-s, c]])
        assert frame.truth["id"].tolist() == [1, 3]
        np.testing.assert_allclose(frame.relative_velocity_px_s, own, atol=1e-12)


# --- sky --------------------------------------------------------------------------------------


def test_stars_that_leave_come_back_to_the_same_place():
    simulator = simulate(period_s=100, star_count=150, pixel_scale_arcsec=1)
    start = simulator.frame()
    simulator.camera_rate_arcsec_s = (37, -23)  # 3,700 and 2,300 px: many tiles
    simulator.frame()
    simulator.camera_rate_arcsec_s = (0, 0)
    away = simulator.frame()
    simulator.camera_rate_arcsec_s = (-37, 23)
    simulator.frame()
    simulator.camera_rate_arcsec_s = (0, 0)
    back = simulator.frame()
    assert len(np.intersect1d(start.stars["flux"], away.stars["flux"])) == 0
    assert np.array_equal(start.stars["flux"], back.stars["flux"])
    assert np.allclose(places(start.stars), places(back.stars), atol=1e-6)


def test_every_star_that_stays_in_view_is_still_there_after_a_drift_over_tiles():
    # 100 px a frame over tiles of the sky, in a direction where both coordinates turn negative.
    simulator = simulate(camera_rate_arcsec_s=(-500, -300), exposure_s=0.1, star_count=300)
    last = simulator.frame()
    for _ in range(8):
        frame = simulator.frame()
        moved = places(last.stars) + frame.displacement_px
        inside = np.all((moved > 0) & (moved < 511), axis=1)
        assert np.isin(last.stars["flux"][inside], frame.stars["flux"]).all()
        last = frame


def test_the_sky_does_not_run_out_of_stars():
    # 16 hours at star rate: 864,000 arcsec.
    simulator = simulate(camera_rate_arcsec_s=(15, 0), period_s=3600, star_count=150)
    counts = [len(simulator.frame().stars) for _ in range(16)]
    # Poisson, mean 150: the mean of 16 has a std of 3.1.
    assert np.mean(counts) == pytest.approx(150, abs=4 * 3.1)
    assert min(counts) > 100


def test_star_fluxes_are_within_their_range_and_more_are_faint():
    stars = simulate(star_count=2000, star_flux_percent=(10, 1000), bit_depth=12).frame().stars
    assert stars.dtype == STAR_DTYPE
    percent = stars["flux"] / 4095 * 100
    assert percent.min() >= 10
    assert percent.max() <= 1000
    # 1/F even between 1/1000 and 1/10: the median is 19.8, with 2,000 stars to about 0.4.
    assert np.median(percent) == pytest.approx(19.8, abs=1.7)


def test_no_part_of_the_sky_repeats():
    stars = simulate(width=1024, height=1024, star_count=600).frame().stars
    assert len(np.unique(stars["flux"])) == len(stars) > 500


def test_stars_outside_the_image_light_its_border():
    settings = {**NOISELESS, "star_count": 400, "star_flux_percent": (100, 101)}
    whole = simulate(**{**settings, "width": 128, "height": 128, "star_count": 1600}).frame()
    part = simulate(**settings).frame()
    # The same sky in an image of half the size: its border must not know of the cut.
    assert np.array_equal(part.image, whole.image[32:96, 32:96])
    assert len(part.stars) < len(whole.stars)


# --- sensor -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_pixels_saturate_at_full_scale(bits, dtype):
    frame = simulate(rsos=(RSO((30, 30), (0, 0), 5000),), bit_depth=bits, **NOISELESS).frame()
    full = 2**bits - 1
    assert frame.image.dtype == dtype
    assert frame.image.max() == full
    # Peak 0.147 of the flux, over 7 times full scale: all within 2 px are saturated.
    assert np.count_nonzero(frame.image == full) == 13
    assert frame.truth["flux"][0] == pytest.approx(50 * full)


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_noise_has_the_mean_and_std_asked_for(bits):
    frame = simulate(
        width=500, height=400, bit_depth=bits, star_count=0,
        noise_mean_percent=5, noise_std_percent=1.2,
    ).frame()  # fmt: skip
    full, count = 2**bits - 1, 500 * 400
    std = math.hypot(0.012 * full, math.sqrt(1 / 12))  # rounding adds 1/12 DN^2
    assert frame.image.mean() == pytest.approx(0.05 * full, abs=5 * std / math.sqrt(count))
    # 5 std of a measured std, and nothing is clipped at 4.2 std below the mean but 1 in 1e5.
    assert frame.image.std() == pytest.approx(std, rel=5 / math.sqrt(2 * count))


def test_noise_is_white_and_new_in_every_frame():
    simulator = simulate(**{**DARK, "noise_mean_percent": 50, "width": 256, "height": 256})
    first, second = (simulator.frame().image.astype(float) for _ in range(2))
    first, second = first - first.mean(), second - second.mean()
    for other in (second, np.roll(first, 1, 0), np.roll(first, 1, 1)):
        # Correlation of 65,536 independent pairs: std 0.0039.
        assert abs(np.mean(first * other)) / first.var() < 5 * 0.0039


def test_photon_noise_has_the_variance_of_the_light():
    settings = {"rsos": (RSO((31, 33), (0, 0), 20000),), "psf_sigma_px": 12.0}
    settings = {**settings, **DARK, "noise_mean_percent": 2, "noise_std_percent": 0.1}
    light = simulate(**{**settings, "noise_std_percent": 0}).frame().image - 0.02 * 65535
    simulator = simulate(electrons_per_dn=0.5, frames=200, **settings)
    images = np.stack([frame.image for frame in simulator]).astype(float)
    bright = light > 3000
    assert bright.sum() > 500
    assert light.max() < 60000
    expected = light / 0.5 + (0.001 * 65535) ** 2
    # Each of the 200-frame variances has a relative std of 0.1; 500 or more of them.
    ratio = (images.var(axis=0, ddof=1) / expected)[bright]
    assert ratio.mean() == pytest.approx(1, abs=5 * 0.1 / math.sqrt(bright.sum()))
    # Bright and less bright alike: it is not only the sum that fits.
    brighter = light[bright] > np.median(light[bright])
    assert ratio[brighter].mean() == pytest.approx(ratio[~brighter].mean(), abs=0.04)
    error = (images.mean(axis=0) - light - 0.02 * 65535)[bright] / np.sqrt(expected[bright] / 200)
    assert abs(error.mean()) < 5 / math.sqrt(bright.sum())


@pytest.mark.parametrize("electrons_per_dn", [0, 0.01])
def test_truth_snr_is_that_of_a_matched_filter_on_real_draws(electrons_per_dn):
    settings = {"width": 48, "height": 40, "star_count": 0, "exposure_s": 1.0}
    settings["rsos"] = (RSO((18, 17), (40, 20), 60),)
    template = simulate(noise_std_percent=0, noise_mean_percent=0, **settings).frame()
    signal = template.image.astype(float)
    variance = np.full(signal.shape, (0.01 * 65535) ** 2)
    if electrons_per_dn:
        variance += signal / electrons_per_dn
    weights = signal / variance
    draws = [
        simulate(seed=seed, electrons_per_dn=electrons_per_dn, **settings).frame()
        for seed in range(1000)
    ]
    sums = np.array([np.sum(weights * (frame.image - 0.05 * 65535)) for frame in draws])
    empirical = sums.mean() / sums.std(ddof=1)
    (snr,) = draws[0].truth["snr"]
    # The std of 1,000 draws is known to 2.2 %.
    assert snr == pytest.approx(empirical, rel=4 * 0.022)
    assert 5 < snr < 20
    # And against the same sum over the rendered template, whose rounding alone differs.
    assert snr == pytest.approx(math.sqrt(np.sum(signal**2 / variance)), rel=1e-3)


def test_the_same_picture_at_every_bit_depth():
    deep, shallow = (scenario("survey", bit_depth=bits).frame() for bits in (16, 8))
    assert np.abs(deep.image / 257 - shallow.image).max() <= 0.5  # half a DN of 8 bits
    assert np.allclose(deep.truth["flux"], shallow.truth["flux"] * 257)


# --- what spoils a frame ----------------------------------------------------------------------


def test_the_sky_rises_from_border_to_border():
    sky = {"sky_percent": 4, "sky_gradient_percent": (3, -5)}
    image = simulate(**{**NOISELESS, "width": 101, "height": 81}, **sky).frame().image
    rows, columns = np.mgrid[:81, :101]
    expected = 65535 / 100 * (4 + 3 * columns / 100 + 5 * (1 - rows / 80))
    assert np.abs(image - expected).max() < 0.51  # rounding


def test_the_skys_light_has_photon_noise_and_the_noises_mean_has_not():
    settings = {**NOISELESS, "width": 300, "height": 200, "noise_mean_percent": 10}
    image = simulate(sky_percent=5, electrons_per_dn=0.5, **settings).frame().image.astype(float)
    count, variance = image.size, 0.05 * 65535 / 0.5
    assert image.mean() == pytest.approx(0.15 * 65535, abs=5 * math.sqrt(variance / count))
    assert image.var() == pytest.approx(variance + 1 / 12, rel=5 * math.sqrt(2 / count))


def test_vignetting_takes_light_with_the_square_of_the_distance():
    settings = {**NOISELESS, "width": 121, "height": 91, "vignetting": 0.4}
    sky = simulate(sky_percent=50, **settings).frame().image / (0.5 * 65535)
    assert sky[45, 60] == pytest.approx(1, abs=2e-5)  # rounding, half of 1 / 32768
    assert [sky[y, x] for y in (0, -1) for x in (0, -1)] == pytest.approx([0.6] * 4, abs=2e-5)
    assert sky[21, 28] == pytest.approx(1 - 0.4 * (32**2 + 24**2) / (60**2 + 45**2), abs=2e-5)
    rso = RSO((28, 21), (0, 0), 100)
    frame = simulate(rsos=(rso,), **settings).frame()
    assert frame.truth["flux"][0] == pytest.approx(sky[21, 28] * 65535, rel=1e-3)
    # Rounding, 0.29 DN rms in 121 pixels: 3 DN rms.
    assert frame.image.sum(dtype=float) == pytest.approx(frame.truth["flux"][0], abs=15)
    plain = simulate(rsos=(rso,), **{**settings, "vignetting": 0}).frame()
    assert plain.truth["flux"][0] == pytest.approx(65535)
    # The curve of the vignetting within the PSF is all that shows beside its depth.
    ratio = frame.truth["snr"][0] / plain.truth["snr"][0]
    assert ratio == pytest.approx(sky[21, 28], rel=1e-3)


@pytest.mark.parametrize("std", [0.01, 0.1])
def test_gains_act_on_light_and_are_fixed_in_the_sensor(std):
    settings = {**NOISELESS, "width": 256, "height": 200, "gain_std": std}
    simulator = simulate(sky_percent=40, camera_rate_arcsec_s=(50, 0), **settings)
    first, second = (simulator.frame().image for _ in range(2))
    gain = first / (0.4 * 65535)
    assert np.array_equal(first, second)
    assert gain.mean() == pytest.approx(1, abs=5 * std / math.sqrt(gain.size))
    assert gain.std() == pytest.approx(std, rel=5 / math.sqrt(2 * gain.size))
    # The same gains under other light; both are known to half a DN of rounding.
    dimmer = simulate(sky_percent=20, **settings).frame().image / (0.2 * 65535)
    assert np.abs(gain - dimmer).max() < 1e-4
    # What is not light has none.
    dark = simulate(**{**settings, "noise_mean_percent": 40}).frame().image
    assert np.all(dark == round(0.4 * 65535))
    other = simulate(sky_percent=40, seed=2, **settings).frame().image
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 5 / math.sqrt(gain.size)


def test_the_fixed_pattern_is_an_offset_that_stays():
    settings = {**NOISELESS, "width": 256, "height": 200, "noise_mean_percent": 10}
    settings["fixed_pattern_std_percent"] = 0.5
    simulator = simulate(camera_rate_arcsec_s=(50, 0), **settings)
    first, second = (simulator.frame().image.astype(float) for _ in range(2))
    assert np.array_equal(first, second)
    count, std = first.size, 0.005 * 65535
    assert first.mean() == pytest.approx(0.1 * 65535, abs=5 * std / math.sqrt(count))
    assert first.std() == pytest.approx(std, rel=5 / math.sqrt(2 * count))
    # It adds to light, and does not scale it; both are rounded.
    bright = simulate(sky_percent=30, **settings).frame().image
    assert np.abs(bright - first - 0.3 * 65535).max() <= 1


def test_hot_pixels_are_as_many_and_as_bright_as_asked_for_and_stay():
    settings = {**NOISELESS, "width": 400, "height": 300, "hot_pixel_percent": (2, 50)}
    simulator = simulate(hot_pixel_fraction=0.01, camera_rate_arcsec_s=(50, 0), **settings)
    first, second = (simulator.frame().image for _ in range(2))
    assert np.array_equal(first, second)
    percent = first[first > 0] / 655.35
    # Binomial: 1200 of 120,000, std 34.5.
    assert len(percent) == pytest.approx(1200, abs=5 * 34.5)
    assert percent.min() >= 2 - 1e-3
    assert percent.max() <= 50 + 1e-3
    # Even in the logarithm over a range of log(25): its mean is log(10), with a std of 1/sqrt(12).
    spread = math.log(25) / math.sqrt(12 * len(percent))
    assert np.log(percent).mean() == pytest.approx(math.log(10), abs=5 * spread)
    rows, columns = np.nonzero(first)
    assert np.histogram2d(rows, columns, 3)[0].min() > 133 - 5 * math.sqrt(133)  # everywhere
    # All other pixels, and all other noise, are those of a sound sensor.
    sound, hot = (
        simulate(**{**settings, "noise_std_percent": 1, "noise_mean_percent": 5, **more}).frame()
        for more in ({}, {"hot_pixel_fraction": 0.01})
    )
    assert np.array_equal(hot.image[first == 0], sound.image[first == 0])


def test_hot_pixels_have_the_photon_noise_of_their_signal():
    settings = {**NOISELESS, "hot_pixel_fraction": 1, "hot_pixel_percent": (2, 50)}
    mean = simulate(**settings).frame().image.astype(float)
    images = np.stack([f.image for f in simulate(electrons_per_dn=0.2, frames=60, **settings)])
    ratio = images.var(axis=0, ddof=1) / (mean / 0.2)
    # Each of the 60-frame variances has a relative std of sqrt(2/59).
    assert ratio.mean() == pytest.approx(1, abs=5 * math.sqrt(2 / 59 / ratio.size))


def test_dark_signal_has_no_gain_and_its_photon_noise_counts_in_the_snr():
    dark = {**DARK, "hot_pixel_fraction": 1, "hot_pixel_percent": (20, 20)}
    image = simulate(gain_std=0.3, **{**dark, "noise_std_percent": 0}).frame().image
    assert np.all(image == 0.2 * 65535)
    rso = RSO((30, 30), (0, 0), 100)
    signal = simulate(rsos=(rso,), **NOISELESS).frame().image.astype(float)
    variance = (0.01 * 65535) ** 2 + (signal + 0.2 * 65535) / 0.01
    (snr,) = simulate(rsos=(rso,), electrons_per_dn=0.01, **dark).frame().truth["snr"]
    # The template's rounding alone differs.
    assert snr == pytest.approx(math.sqrt(np.sum(signal**2 / variance)), rel=1e-3)


def rays_of(image):
    """Number of pixels and the light, in percent, of each group of pixels that touch."""
    count, labels = cv2.connectedComponents((image > 0).astype(np.uint8), connectivity=8)
    pixels = np.bincount(labels.ravel(), minlength=count)[1:]
    return pixels, np.bincount(labels.ravel(), image.ravel(), count)[1:] / 655.35


def test_cosmic_rays_are_single_pixels_and_short_tracks_that_do_not_come_back():
    settings = {**NOISELESS, "width": 512, "height": 512, "cosmic_ray_percent": (10, 20)}
    images = [frame.image for frame in simulate(cosmic_ray_count=30, frames=12, **settings)]
    assert max(np.count_nonzero((a > 0) & (b > 0)) for a, b in itertools.pairwise(images)) <= 6
    found = [rays_of(image) for image in images]
    counts = [len(pixels) for pixels, _ in found]
    # Poisson, 30 a frame: the sum of 12 has a std of 19; a few touch another or leave the image.
    assert sum(counts) == pytest.approx(360, abs=4 * 19)
    assert np.std(counts) > 2
    pixels, percent = (np.concatenate(parts) for parts in zip(*found, strict=True))
    single = pixels == 1
    # Half, and those of the tracks that are too short to leave their pixel, about one in ten.
    assert np.mean(single) == pytest.approx(0.55, abs=4 * math.sqrt(0.25 / 360))
    # 10 to 20 % per pixel, in a single pixel and per px of a track.
    whole = percent[single & (percent > 9.9)]
    assert len(whole) > 0.95 * single.sum()
    assert whole.max() <= 20.01
    assert np.median(whole) == pytest.approx(math.sqrt(200), abs=1.0)
    # Tracks: 4 px long in the mean, as far as they are not clipped.
    length = percent[~single] / math.sqrt(200)
    assert length.mean() == pytest.approx(4.4, abs=4 * 4 / math.sqrt(len(length)))
    assert pixels.max() < 60
    # Everything else is as it would be without.
    noise = {**settings, "noise_std_percent": 1, "noise_mean_percent": 5}
    clean, hit = simulate(**noise).frame(), simulate(cosmic_ray_count=30, **noise).frame()
    untouched = images[0] == 0
    assert np.array_equal(clean.image[untouched], hit.image[untouched])
    assert np.all(hit.image[~untouched] > clean.image[~untouched])
    assert hit.truth.tobytes() == clean.truth.tobytes()


@pytest.mark.parametrize("cover", [0.1, 0.5, 1.0])
def test_clouds_cover_the_share_of_the_sky(cover):
    settings = {**NOISELESS, "cloud_cover": cover, "cloud_glow_percent": 50}
    images = [simulate(seed=seed, **settings).frame().image for seed in range(60)]
    covered = np.array([np.mean(image > 0) for image in images])
    # An image sees a quarter of the pattern; what the 60 measure is known from their spread.
    assert covered.mean() == pytest.approx(cover, abs=4 * covered.std() / math.sqrt(60) + 1e-3)
    # Patchy, and up to the glow asked for.
    assert max(image.max() for image in images) == round(0.5 * 65535)
    assert covered.std() > 0.02 or cover == 1


def test_clouds_drift():
    clouds = {"cloud_cover": 0.5, "cloud_glow_percent": 80, "cloud_drift_px_s": (6, -4)}
    simulator = simulate(**{**NOISELESS, **clouds, "width": 160, "height": 120}, period_s=2)
    first, second = (simulator.frame().image.astype(int) for _ in range(2))
    assert first.std() > 0.1 * 65535
    # 2 s: 12 px to the right and 8 px up, whole pixels, so only rounding differs.
    assert np.abs(second[:-8, 12:] - first[8:, :-12]).max() <= 1
    assert np.abs(second - first).max() > 1000


def test_clouds_take_from_stars_and_rsos_what_their_thickness_says():
    clouds = {"cloud_cover": 0.7, "cloud_opacity": 0.6, "cloud_glow_percent": 20}
    sky = {**NOISELESS, **clouds, "width": 200, "height": 200}
    empty = simulate(**sky).frame().image.astype(float)
    thickness = empty / (0.2 * 65535)
    places_px = [(x, y) for x in (30, 70, 110, 150) for y in (40, 100, 160)]
    rsos = [RSO(place, (0, 0), 100) for place in places_px]
    frame = simulate(rsos=rsos, **sky).frame()
    light = frame.image - empty
    clear = simulate(rsos=rsos, **{**sky, "cloud_cover": 0}).frame()
    for (x, y), truth, before in zip(places_px, frame.truth, clear.truth, strict=True):
        around = np.s_[y - 10 : y + 11, x - 10 : x + 11]
        left = np.average(1 - 0.6 * thickness[around], weights=clear.image[around])
        # Rounding, of both images and in 441 pixels: 9 DN rms each.
        assert truth["flux"] == pytest.approx(left * 65535, abs=45)
        assert light[around].sum() == pytest.approx(truth["flux"], abs=45)
        # The clouds' slope within the PSF is all that shows beside their thickness.
        assert truth["snr"] / before["snr"] == pytest.approx(left, rel=0.01)
    assert frame.truth["flux"].min() < 0.6 * 65535 < 0.9 * 65535 < frame.truth["flux"].max()
    # Stars the same: all light, and every pixel of it.
    stars = {"star_count": 60, "star_flux_percent": (20, 60)}
    shaded, plain = (
        simulate(**{**sky, **stars, "cloud_cover": cover}).frame().image for cover in (0.7, 0)
    )
    assert np.abs(shaded - empty - plain * (1 - 0.6 * thickness)).max() < 3  # rounding, thrice
    assert plain.max() > 3000


def test_clouds_fit_themselves_to_the_image():
    clouds = {"cloud_cover": 0.5, "cloud_glow_percent": 50}
    small, large = (
        simulate(**{**NOISELESS, **clouds, "width": size, "height": size}).frame().image
        for size in (64, 256)
    )
    shrunk = large.reshape(64, 4, 64, 4).mean(axis=(1, 3))
    # Cells of 1 and of 4 px: half a cell of shift apart.
    assert np.corrcoef(small.ravel(), shrunk.ravel())[0, 1] > 0.99


def test_a_tumbling_rsos_flux_and_snr_vary_as_its_image_does():
    tumble = {"flux_amplitude": 0.8, "flux_period_s": 7.0, "flux_phase_rad": 1.0}
    steady = RSO((30, 31), (0, 0), 80)
    settings = {**NOISELESS, "exposure_s": 2.0, "period_s": 3.0, "frames": 9, "subsamples": 40}
    frames = list(simulate(rsos=(dataclasses.replace(steady, **tumble),), **settings))
    flux = np.array([frame.truth["flux"][0] for frame in frames])
    # The mean of 1 + a sin(w t + p) over an exposure: the sine in its middle times sinc(w T / 2).
    middle = np.arange(9) * 3.0 + 1.0
    half = math.pi / 7 * 2.0
    sine = np.sin(2 * math.pi * middle / 7 + 1) * math.sin(half) / half
    # The midpoint rule with 40 instants is wrong by (w T / 40)^2 / 24, 8e-5 of the amplitude.
    assert flux == pytest.approx(0.8 * 65535 * (1 + 0.8 * sine), rel=5e-4)
    assert flux.max() > 3 * flux.min()
    light = np.array([frame.image.sum(dtype=float) for frame in frames])
    assert light == pytest.approx(flux, abs=36)  # rounding, as above
    snr = np.array([frame.truth["snr"][0] for frame in frames])
    plain = simulate(rsos=(steady,), **settings).frame().truth[0]
    assert snr / flux == pytest.approx(np.full(9, plain["snr"] / plain["flux"]))


def test_a_tumbling_rsos_streak_varies_along_its_length():
    # Half a period in the exposure, from the mean down and back: bright ends, a dark middle.
    rso = RSO((12, 30), (200, 0), 500, flux_amplitude=1, flux_period_s=2, flux_phase_rad=math.pi)
    image = simulate(rsos=(rso,), **{**NOISELESS, "subsamples": 100}).frame().image.astype(float)
    profile = image.sum(axis=0)
    # Per px: 5 times full scale over 40 px, times 1 - sin.  At an eighth, 1 - sin(pi/8).
    assert profile[17] == pytest.approx(5 * 65535 / 40 * (1 - math.sin(math.pi / 8)), rel=0.05)
    assert profile[32] < 0.02 * profile[17]


def test_jitter_shifts_stars_and_rsos_alike_and_truth_has_it():
    settings = {"camera_rate_arcsec_s": (10, -5), "field_rotation_rad_s": 0.001, "subsamples": 1}
    settings |= {"width": 200, "height": 160, "star_count": 40}
    settings["rsos"] = (RSO((100, 80), (10, -5), 100),)
    shaken, steady = simulate(jitter_std_px=0.8, **settings), simulate(**settings)
    errors = [np.full(2, np.nan)]
    for _ in range(100):
        frame, quiet = shaken.frame(), steady.frame()
        error = (places(frame.truth) - places(quiet.truth))[0]
        before, after = matched_stars(quiet.stars, frame.stars)
        assert np.allclose(places(after) - places(before), error, atol=1e-9)
        for axis, step in enumerate(("dx_px", "dy_px")):
            more = error[axis] - errors[-1][axis]
            assert np.allclose(after[step] - before[step], more, atol=1e-9, equal_nan=True)
            # The star now at the centre is another, which the turn of 1 mrad moves otherwise.
            moved = frame.displacement_px[axis] - quiet.displacement_px[axis]
            assert moved == pytest.approx(more, abs=4e-3, nan_ok=True)
        errors.append(error)
    errors = np.array(errors[1:])
    # Of 200 numbers: the std to 5 %, the means of 100 to 0.08 px; new in each frame.
    assert errors.std() == pytest.approx(0.8, rel=4 * 0.05)
    assert np.abs(errors.mean(axis=0)).max() < 4 * 0.08
    assert abs(np.mean(errors[1:] * errors[:-1])) / 0.8**2 < 4 / math.sqrt(198)
    # What the mount knows has no part in it.
    assert shaken.pointing_arcsec == steady.pointing_arcsec


def test_jitter_shows_in_the_image_as_in_truth():
    simulator = simulate(rsos=(RSO((31, 30), (0, 0), 200),), jitter_std_px=2, **NOISELESS)
    for _ in range(5):
        frame = simulator.frame()
        x, y = frame.truth["x_px"][0], frame.truth["y_px"][0]
        assert centroid(frame.image, x, y) == pytest.approx((x, y), abs=0.01)
        assert frame.truth["length_px"][0] == 0  # it holds during the exposure
    assert math.hypot(x - 31, y - 30) > 0.1


def test_jitter_is_along_the_images_axes_however_the_field_is_turned():
    rsos = (RSO((31.5, 31.5), (0, 0), 100),)  # in the centre, where a turn doesn't move it
    settings = {"rsos": rsos, "jitter_std_px": 2, **DARK}
    still, turning = simulate(**settings), simulate(field_rotation_rad_s=1, **settings)
    for _ in range(3):
        assert np.allclose(places(still.frame().truth), places(turning.frame().truth))


DEFECTS = {
    "sky_percent": 8,
    "sky_gradient_percent": (3, 2),
    "vignetting": 0.5,
    "gain_std": 0.08,
    "fixed_pattern_std_percent": 1.0,
}


def test_truth_snr_counts_uneven_gains_offsets_sky_and_vignetting():
    settings = {"width": 48, "height": 40, "star_count": 0, "rsos": (RSO((4, 4), (40, 20), 150),)}
    draws = [
        simulate(seed=seed, electrons_per_dn=0.05, **settings, **DEFECTS).frame()
        for seed in range(500)
    ]
    clean = {**settings, **DEFECTS, "gain_std": 0, "fixed_pattern_std_percent": 0}
    clean |= {"noise_std_percent": 0, "noise_mean_percent": 0}
    level = simulate(**clean).frame().image.astype(float)
    sky = simulate(**{**clean, "rsos": ()}).frame().image
    signal = level - sky
    variance = 2 * (0.01 * 65535) ** 2 + level / 0.05 + (0.08 * level) ** 2
    weights = signal / variance
    sums = np.array([np.sum(weights * (frame.image - sky - 0.05 * 65535.0)) for frame in draws])
    (snr,) = draws[0].truth["snr"]
    # Every seed is another sensor.  The std of 500 draws is known to 3.2 %.
    assert snr == pytest.approx(sums.mean() / sums.std(ddof=1), rel=3 * 0.032)
    # Each of them counts here, by more than that.
    for name in ("sky_percent", "vignetting", "gain_std", "fixed_pattern_std_percent"):
        without = {**settings, **DEFECTS, name: 0, "electrons_per_dn": 0.05}
        assert simulate(**without).frame().truth["snr"][0] > 1.1 * snr


@pytest.mark.parametrize("electrons_per_dn", [0, 0.02])
@pytest.mark.parametrize("rate", [(0, 0), (100, -60)])
@pytest.mark.parametrize("snr", [3, 40])
def test_an_rso_may_be_given_by_its_snr(snr, rate, electrons_per_dn):
    settings = {"sky_percent": 6, "gain_std": 0.02, "fixed_pattern_std_percent": 0.4}
    settings |= {"width": 128, "height": 96, "star_count": 0, "subsamples": 20}
    rso = RSO((50.3, 60.8), rate, snr=snr)
    simulator = simulate(rsos=(rso,), electrons_per_dn=electrons_per_dn, **settings)
    assert simulator.frame().truth["snr"][0] == pytest.approx(snr, rel=1e-6)
    (found,) = simulator.rsos
    assert found == dataclasses.replace(rso, flux_percent=found.flux_percent, snr=None)
    again = simulate(rsos=(found,), electrons_per_dn=electrons_per_dn, **settings)
    assert again.frame().truth["snr"][0] == pytest.approx(snr, rel=1e-6)


def test_an_snr_is_of_the_whole_streak_and_of_the_mean_brightness():
    # Half outside of the image, and dark in the first exposure.
    rso = RSO((-0.5, 30), (0, 0), snr=20)
    tumbling = RSO((30, 30), (0, 0), snr=20, flux_amplitude=0.5, flux_phase_rad=-math.pi / 2,
                   flux_period_s=1000)  # fmt: skip
    cut, dark = (simulate(rsos=(r,), **DARK).frame().truth["snr"][0] for r in (rso, tumbling))
    assert cut == pytest.approx(20 / math.sqrt(2), rel=1e-6)
    assert dark == pytest.approx(10, rel=1e-3)


def test_each_kind_of_noise_has_its_own_stream():
    # Adding one effect leaves all others as they were: what differs is what it adds.
    base = {**DARK, **DEFECTS, "sky_percent": 8, "noise_mean_percent": 5}
    plain = simulate(**base).frame().image.astype(float)
    for more in (
        {"hot_pixel_fraction": 0.02},
        {"cosmic_ray_count": 3},
        {"cloud_cover": 0.3, "cloud_glow_percent": 5},
    ):
        changed = simulate(**base, **more).frame().image.astype(float) != plain
        assert 0 < np.mean(changed) < 0.7, more


# --- seed, time, truth -------------------------------------------------------------------------


def test_same_seed_same_bytes():
    one, two, other = (
        list(scenario("survey", seed, width=96, height=80, frames=4, electrons_per_dn=0.1))
        for seed in (5, 5, 6)
    )
    assert len(one) == 4
    for a, b, c in zip(one, two, other, strict=True):
        assert a.image.shape == (80, 96)
        assert a.image.tobytes() == b.image.tobytes()
        assert a.truth.tobytes() == b.truth.tobytes()
        assert a.image.tobytes() != c.image.tobytes()
        assert a.stamp_ns == c.stamp_ns
    # Other stars too, not just other noise.
    assert len(np.intersect1d(one[0].stars["flux"], other[0].stars["flux"])) == 0


def test_same_seed_same_bytes_of_all_that_spoils():
    one, two, other = (scenario("ugly", seed, width=96, height=80, frames=3) for seed in (5, 5, 6))
    for a, b, c in zip(one, two, other, strict=True):
        assert a.image.tobytes() == b.image.tobytes()
        assert a.truth.tobytes() == b.truth.tobytes()
        assert a.displacement_px.tobytes() == b.displacement_px.tobytes()
        assert a.image.tobytes() != c.image.tobytes()


def test_stamps_are_the_middle_of_the_exposures():
    simulator = simulate(exposure_s=0.3, period_s=0.7, frames=3, **DARK)
    frames = list(simulator)
    start = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
    assert [frame.stamp_ns - start for frame in frames] == [150000000, 850000000, 1550000000]
    assert all(type(frame.stamp_ns) is int for frame in frames)
    assert [frame.frame for frame in frames] == [0, 1, 2]
    assert len(simulator) == 3
    assert simulator.frame().frame == 3  # it goes on when asked for more
    assert simulate(start_stamp_ns=7, **DARK).frame().stamp_ns == 7 + 500_000_000


def test_truth_has_only_rsos_whose_centre_is_inside():
    # At mid-exposure of frame k, x is 57.5 + 4 k + 2: 59.5, then 63.5, outside (63.5 is the edge).
    rsos = (RSO((57.5, 10), (20, 0), 100), RSO((-3, 20), (20, 0), 100))
    simulator = simulate(rsos=rsos, **DARK)
    first, second = simulator.frame().truth, simulator.frame().truth
    assert first.dtype == TRUTH_DTYPE
    assert first["id"].tolist() == [1]  # the other's centre is at -1
    assert second["id"].tolist() == [2]
    assert second["frame"].tolist() == [1]
    assert second["stamp_ns"].tolist() == [1_767_225_601_500_000_000]
    assert second["x_px"][0] == pytest.approx(3)


def test_an_rso_that_is_cut_by_the_border_has_the_snr_of_what_is_seen():
    middle, border = (
        simulate(rsos=(RSO((x, 30), (0, 0), 100),), **DARK).frame().truth["snr"][0]
        for x in (29.5, -0.5)
    )
    # By symmetry half of sum s^2 is left.
    assert border == pytest.approx(middle / math.sqrt(2), rel=1e-6)


def test_what_an_rso_leaves_open_is_drawn_within_the_ranges():
    ranges = {"random_speed_arcsec_s": (10, 20), "random_flux_percent": (50, 70)}
    rsos = simulate(rsos=(RSO(),) * 50, **ranges).rsos
    speeds = [math.hypot(*rso.rate_arcsec_s) for rso in rsos]
    assert 10 <= min(speeds) < 11.5
    assert 18.5 < max(speeds) <= 20
    angles = [math.atan2(*rso.rate_arcsec_s) for rso in rsos]
    assert np.histogram(angles, 4, (-math.pi, math.pi))[0].min() >= 4
    assert all(50 <= rso.flux_percent <= 70 for rso in rsos)
    assert all(0 < x < 511 and 0 < y < 511 for x, y in (rso.position_px for rso in rsos))
    fixed = simulate(rsos=(RSO(flux_percent=5, rate_arcsec_s=(1, 2)), RSO()), **ranges).rsos
    assert fixed[0] == RSO(rsos[0].position_px, (1, 2), 5)
    assert fixed[1] == rsos[1]


def test_truth_file(tmp_path):
    rows = np.zeros(2, TRUTH_DTYPE)
    rows[0] = (1_767_225_600_500_000_001, 0, 1, 10.12345, -0.0, 1.5, -2.25, 12.3456, 999.5, 2.7)
    rows[1]["id"] = 4_294_967_295
    write_truth(tmp_path / "truth.csv", [rows[:1], rows[:0], rows[1:]])
    assert (tmp_path / "truth.csv").read_text().splitlines() == [
        HEADER,
        "1767225600500000001,0,1,10.1235,0.0000,1.50000,-2.25000,12.346,999.50,2.700",
        "0,0,4294967295,0.0000,0.0000,0.00000,0.00000,0.000,0.00,0.000",
    ]
    write_truth(tmp_path / "empty.csv", [])
    assert (tmp_path / "empty.csv").read_text() == HEADER + "\n"


# --- scenarios --------------------------------------------------------------------------------


def test_scenarios_have_a_line_each():
    plain = ["geo", "sidereal", "survey", "empty", "fast", "slow"]
    spoilt = ["hot_pixels", "vignetting", "clouds", "cosmic_rays", "tumbling", "jitter", "ugly"]
    guided = ["guide_drift", "guide_leo"]
    assert list(SCENARIOS) == plain + spoilt + guided
    assert all(line and "\n" not in line for line in SCENARIOS.values())


@pytest.mark.parametrize("seed", [1, 2])
def test_geo_has_five_stationary_rsos_among_streaking_stars(seed):
    simulator = scenario("geo", seed)
    frames = [simulator.frame() for _ in range(3)]
    for frame in frames:
        assert frame.truth["id"].tolist() == [1, 2, 3, 4, 5]
        assert np.all(frame.truth["vx_px_s"] == 0)
        assert np.all(frame.truth["vy_px_s"] == 0)
        assert np.allclose(places(frame.truth), places(frames[0].truth), atol=1e-9)
        streaks = np.hypot(frame.stars["vx_px_s"], frame.stars["vy_px_s"]) * 2.0
        assert np.allclose(streaks, 6, atol=0.1)  # 15.04 arcsec/s, 5 arcsec/px, 2 s
        # The bright ones are plain to see, the faintest is not lost.
        assert frame.truth["snr"].max() > 50
        assert frame.truth["snr"].min() > 10
    assert np.hypot(*frames[1].displacement_px) == pytest.approx(7.5, abs=0.1)
    # Half a strip of a fifth of the width apart, at least: never blended.
    assert np.diff(np.sort(frames[0].truth["x_px"])).min() > 0.5 * 512 / 5
    assert np.median(frames[0].image) == pytest.approx(0.05 * 65535, rel=0.02)


@pytest.mark.parametrize("size", [{}, {"width": 128, "height": 96, "frames": 20}])
def test_sidereal_has_one_rso_from_the_right_edge_to_the_centre(size):
    simulator = scenario("sidereal", **size)
    width, height = simulator.settings.width, simulator.settings.height
    assert len(simulator) == size.get("frames", 80)
    frames = list(simulator)
    truth = np.concatenate([frame.truth for frame in frames])
    assert truth["frame"].tolist() == list(range(len(frames)))  # visible in each
    step = (width / 2) / (len(frames) - 0.5)
    assert width - 0.5 - step < truth["x_px"][0] < width - 0.5
    assert places(truth)[-1] == pytest.approx([(width - 1) / 2, (height - 1) / 2])
    assert np.allclose(np.diff(truth["x_px"]), -step)
    assert all(np.all(frame.stars["vx_px_s"] == 0) for frame in frames)
    assert truth["snr"][5:].min() > 10


def test_survey_has_rsos_in_many_directions_and_of_many_brightnesses():
    simulator = scenario("survey")
    frame = simulator.frame()
    assert len(frame.truth) >= 7
    own = frame.truth["vx_px_s"] + 0.4, frame.truth["vy_px_s"] - 0.2  # against the stars
    angles = np.sort(np.arctan2(own[1], own[0]))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.pi  # not all to one side
    assert frame.truth["snr"].max() > 8 * frame.truth["snr"].min()
    assert frame.truth["snr"].min() > 3
    assert np.allclose(frame.stars["vx_px_s"], -0.4)


def test_empty_has_stars_and_no_rso():
    frames = list(scenario("empty", width=128, height=128, frames=5))
    assert all(len(frame.truth) == 0 and frame.truth.dtype == TRUTH_DTYPE for frame in frames)
    # As many per area at any size: 8e-4 per px, here 13 in the mean.
    assert all(5 <= len(frame.stars) <= 30 for frame in frames)
    assert len(scenario("empty", width=1024, height=1024).frame().stars) == pytest.approx(
        839, abs=116
    )


def test_fast_rsos_streak_and_slow_ones_creep():
    for name, low, high in (("fast", 10, 60), ("slow", 0.5, 2)):
        simulator = scenario(name)
        truth = np.concatenate([frame.truth for frame in simulator])
        first = truth[truth["frame"] == 0]
        steps = np.hypot(first["vx_px_s"], first["vy_px_s"]) * simulator.settings.period_s
        assert np.sort(steps)[[0, -1]] == pytest.approx([low, high])
        assert first["snr"] == pytest.approx([60, 30, 15, 8, 5], rel=1e-6)
        assert np.allclose(first["length_px"], steps * (0.5 if name == "fast" else 1))
        assert simulator.frame().displacement_px == pytest.approx([0, 0])


# Which settings make each scenario's effect, and where it shows.
SPOILT = {
    "hot_pixels": ("hot_pixel_fraction", "gain_std", "fixed_pattern_std_percent"),
    "vignetting": ("vignetting", "sky_gradient_percent"),
    "clouds": ("cloud_cover",),
    "cosmic_rays": ("cosmic_ray_count",),
    "jitter": ("jitter_std_px",),
    "ugly": ("hot_pixel_fraction", "cloud_cover", "cosmic_ray_count", "jitter_std_px"),
}


@pytest.mark.parametrize("name", [*SPOILT, "tumbling", "fast", "slow"])
def test_spoilt_scenarios_have_five_rsos_that_stay(name):
    simulator = scenario(name, 2)
    assert simulator.settings.width == simulator.settings.height == 512
    frames = list(simulator)
    assert 8 <= len(frames) <= 10
    truth = np.concatenate([frame.truth for frame in frames])
    assert truth[truth["frame"] == 0]["id"].tolist() == [1, 2, 3, 4, 5]
    assert len(truth) >= 0.95 * 5 * len(frames)
    assert truth["snr"].max() > 40
    assert np.count_nonzero(truth["snr"] < 10) >= len(frames)


@pytest.mark.parametrize("name", SPOILT)
def test_spoilt_scenarios_show_their_effect(name):
    spoilt = scenario(name).frame().image.astype(float)
    for field in SPOILT[name]:
        default = getattr(SimulatorSettings(), field)
        cured = scenario(name, **{field: default}).frame().image
        assert not np.array_equal(spoilt, cured), field


def test_tumbling_rsos_flux_varies_by_more_than_2():
    truth = np.concatenate([frame.truth for frame in scenario("tumbling")])
    for number in range(1, 6):
        flux = truth["flux"][truth["id"] == number]
        assert flux.max() > 2 * flux.min()


def test_scenario_takes_other_rsos():
    simulator = scenario("empty", rsos=[RSO((10, 10), (0, 0), 50)])
    assert simulator.rsos == (RSO((10, 10), (0, 0), 50),)


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"width": 0}, "width must be an integer within 16 to 16384, not 0"),
        ({"height": 100.5}, "height must be an integer"),
        ({"bit_depth": 7}, "bit_depth must be an integer within 8 to 16, not 7"),
        ({"bit_depth": True}, "bit_depth must be an integer"),
        ({"psf_sigma_px": 0}, "psf_sigma_px must be a number within 0.2 to 20"),
        ({"star_count": math.nan}, "star_count must be a number .* not nan"),
        ({"star_count": "many"}, "star_count must be a number .* not 'many'"),
        ({"camera_rate_arcsec_s": 15}, "camera_rate_arcsec_s must be a pair of numbers, not 15"),
        ({"camera_rate_arcsec_s": "15"}, "must be a pair of numbers"),
        ({"camera_rate_arcsec_s": (1, math.inf)}, "camera_rate_arcsec_s must be a number"),
        ({"star_flux_percent": (5, 2)}, r"must be \(least, greatest\), not \(5, 2\)"),
        ({"hot_pixel_percent": (9, 3)}, r"must be \(least, greatest\), not \(9, 3\)"),
        ({"cosmic_ray_percent": (0, 3)}, "cosmic_ray_percent must be a number within 0.001 to"),
        ({"hot_pixel_fraction": 2}, "hot_pixel_fraction must be a number within 0 to 1, not 2"),
        ({"gain_std": -0.1}, "gain_std must be a number within 0 to 0.5, not -0.1"),
        ({"cloud_cover": math.inf}, "cloud_cover must be a number within 0 to 1, not inf"),
        ({"sky_gradient_percent": 3}, "sky_gradient_percent must be a pair of numbers, not 3"),
        ({"jitter_std_px": "0.5"}, "jitter_std_px must be a number within 0 to 100"),
        ({"exposure_s": 2.0}, "exposure_s .2. must not exceed period_s .1.: shorten"),
        ({"rsos": (1,)}, "rsos must be a sequence of RSO"),
        ({"rsos": 3}, "rsos must be a sequence of RSO"),
    ],
)
def test_bad_settings_are_refused_with_what_is_allowed(bad, message):
    with pytest.raises(ParameterError, match=message):
        SimulatorSettings(**bad)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"position_px": (1, 2, 3)}, "position_px must be a pair"),
        ({"rate_arcsec_s": (math.nan, 0)}, "rate_arcsec_s must be a number"),
        ({"flux_percent": -1}, "flux_percent must be a number within 0 to"),
        ({"flux_percent": 5, "snr": 5}, r"flux_percent \(5\) or an snr \(5\), not both"),
        ({"snr": 0}, "snr must be a number within 0.001 to 10000, not 0"),
        ({"flux_amplitude": 1.5}, "flux_amplitude must be a number within 0 to 1, not 1.5"),
        ({"flux_period_s": 0}, "flux_period_s must be a number within 0.001 to"),
    ],
)
def test_bad_rsos_are_refused(bad, message):
    with pytest.raises(ParameterError, match=message):
        RSO(**bad)


def test_an_snr_that_no_flux_gives_is_refused():
    # With gains uneven by 20 %, each of the dozen pixels that count adds at most an SNR of 5.
    with pytest.raises(ParameterError, match=r"an snr of 100: lower it.*gain_std \(0.2\)"):
        simulate(rsos=(RSO(snr=100),), gain_std=0.2, **DARK)


def test_a_bad_camera_rate_is_refused_and_the_old_one_stays():
    simulator = simulate(camera_rate_arcsec_s=(1, 2), pixel_scale_arcsec=1, **DARK)
    with pytest.raises(ParameterError, match="moves the field by 50000 px in one exposure"):
        simulator.camera_rate_arcsec_s = (30000, 40000)
    with pytest.raises(ParameterError, match="camera_rate_arcsec_s must be a number"):
        simulator.camera_rate_arcsec_s = (0, math.nan)
    assert simulator.camera_rate_arcsec_s == (1, 2)


def test_unknown_names_are_refused_with_a_hint():
    with pytest.raises(ParameterError, match="no scenario 'leo'; there are geo, sidereal"):
        scenario("leo")
    with pytest.raises(ParameterError, match=r"no setting 'widht'.*did you mean width"):
        scenario("geo", widht=100)
    with pytest.raises(ParameterError, match=r"no setting 'q'.*there are width, height"):
        scenario("geo", q=1)


def test_settings_are_frozen_and_comparable():
    settings = SimulatorSettings(camera_rate_arcsec_s=[1, 2], width=np.int64(100))
    assert settings == SimulatorSettings(camera_rate_arcsec_s=(1.0, 2.0), width=100)
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.width = 5
