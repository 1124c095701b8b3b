"""The simulator: what it renders is what its settings and its truth say."""

import dataclasses
import math

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


def test_scenarios_are_the_four_with_a_line_each():
    assert list(SCENARIOS) == ["geo", "sidereal", "survey", "empty"]
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
    ],
)
def test_bad_rsos_are_refused(bad, message):
    with pytest.raises(ParameterError, match=message):
        RSO(**bad)


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
