# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""World coordinates of FITS as camera and attitude, against astropy.wcs."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from ofsat_ros.camera import to_radec
from ofsat_ros.recordings import open_recording

MAS = np.radians(1e-3 / 3600)
WIDTH, HEIGHT = 400, 300
SCALE_DEG = 10.0 / 3600
XY = np.stack(np.meshgrid(np.linspace(0, 399, 11), np.linspace(0, 299, 11)), -1).reshape(-1, 2)


def header(ra, dec, roll=30.0, mirrored=True, projection="TAN", **cards):
    """Return world coordinates as software writes them: first row at the bottom, if mirrored."""
    turn = np.radians(roll)
    cd = SCALE_DEG * np.array([[-np.cos(turn), -np.sin(turn)], [np.sin(turn), -np.cos(turn)]])
    cd[:, 1] *= -1 if mirrored else 1
    written = fits.Header()
    written["CTYPE1"], written["CTYPE2"] = f"RA---{projection}", f"DEC--{projection}"
    written["CRVAL1"], written["CRVAL2"] = ra, dec
    written["CRPIX1"], written["CRPIX2"] = 190.3, 144.8
    for i, j in np.ndindex(2, 2):
        written[f"CD{i + 1}_{j + 1}"] = cd[i, j]
    written["RADESYS"] = "ICRS"
    written.update(cards)
    return written


def write(path, world, stamp="2026-11-22T03:04:05"):
    image = np.arange(HEIGHT, dtype=np.uint16)[:, None] + np.zeros(WIDTH, np.uint16)
    world = world.copy()
    world["DATE-OBS"], world["EXPTIME"] = stamp, 2.0
    fits.PrimaryHDU(image, world).writeto(path, overwrite=True)
    return path


def unit_vectors(ra, dec):
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)


def error_mas(path):
    """Return by how much our directions of pixels differ at most from astropy's."""
    with open_recording(path) as recording:
        (frame,) = recording
        problems = recording.problems
    ((stamp_ns, attitude),) = frame.attitudes
    assert stamp_ns == frame.stamp_ns
    assert frame.camera is not None
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)
    # The test image tells the row of the file that each row of the frame was.
    file_xy = np.stack([XY[:, 0], np.interp(XY[:, 1], range(HEIGHT), frame.image[:, 0])], -1)
    theirs = WCS(fits.getheader(path), fix=False).pixel_to_world(*file_xy.T).icrs
    ours = to_radec(frame.camera.lines_of_sight(XY), attitude)
    off = unit_vectors(*ours) - unit_vectors(theirs.ra.rad, theirs.dec.rad)
    return np.linalg.norm(off, axis=1).max() / MAS, problems


@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize(
    "place", [(83.6, 22.0), (0.001, 0.0), (359.9, -75.0), (120.0, 89.95), (10.0, -90.0)]
)
def test_directions_are_those_of_astropy(tmp_path, place, mirrored):
    error, problems = error_mas(write(tmp_path / "a.fits", header(*place, mirrored=mirrored)))
    assert error < 1e-3
    assert any("by their WCS, the first row" in words for words in problems) == mirrored


@pytest.mark.parametrize(
    "cards",
    [
        {"RADESYS": "FK5", "EQUINOX": 2000.0},
        {"RADESYS": "FK5", "EQUINOX": 1975.0},
        {"CTYPE1": "GLON-TAN", "CTYPE2": "GLAT-TAN"},
        {"LONPOLE": 123.0},
        {
            "CD1_1": -0.9 * SCALE_DEG,
            "CD2_1": 0.1 * SCALE_DEG,
        },  # neither square nor at right angles
        {"CTYPE1": "DEC--TAN", "CTYPE2": "RA---TAN", "CRVAL1": 22.0, "CRVAL2": 83.6},
    ],
    ids=["FK5", "of 1975", "galactic", "pole", "skew", "swapped"],
)
def test_frames_axes_and_poles(tmp_path, cards):
    error, _ = error_mas(write(tmp_path / "a.fits", header(83.6, 22.0, **cards)))
    assert error < 1e-3


def test_the_old_catalogue_frame_is_nearly_a_rotation(tmp_path):
    world = header(83.6, 22.0, RADESYS="FK4", EQUINOX=1950.0)
    error, _ = error_mas(write(tmp_path / "a.fits", world))
    assert error < 10  # its aberration terms of 0.34" change over the field


def test_the_old_way_to_write_rotation(tmp_path):
    world = header(83.6, 22.0)
    for i, j in np.ndindex(2, 2):
        del world[f"CD{i + 1}_{j + 1}"]
    world["CDELT1"], world["CDELT2"], world["CROTA2"] = -SCALE_DEG, SCALE_DEG, 25.0
    error, _ = error_mas(write(tmp_path / "a.fits", world))
    assert error < 1e-3


@pytest.mark.parametrize("projection", ["ARC", "SIN", "ZEA", "STG"])
def test_other_lenses_projections(tmp_path, projection):
    error, problems = error_mas(
        write(tmp_path / "a.fits", header(83.6, 22.0, projection=projection))
    )
    assert error < 0.1
    assert len(problems) == 2  # the stamps' middle, the rows


def test_radial_distortion_in_sip_becomes_that_of_the_lens(tmp_path):
    strength = 3e-8  # 0.2 to 0.5 px at the corners
    sip = {"A_ORDER": 3, "B_ORDER": 3}
    sip |= dict.fromkeys(("A_3_0", "A_1_2", "B_0_3", "B_2_1"), strength)
    world = header(83.6, 22.0, projection="TAN-SIP", **sip)
    error, problems = error_mas(write(tmp_path / "a.fits", world))
    assert error < 1  # of 10,000 mas in a pixel
    assert len(problems) == 2


def test_how_well_other_distortion_is_followed_is_said(tmp_path):
    sip = {"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 2e-5, "A_0_2": -1e-5, "B_1_1": 2e-5}
    world = header(83.6, 22.0, projection="TAN-SIP", **sip)
    error, problems = error_mas(write(tmp_path / "a.fits", world))
    assert error < 5000
    assert "is followed to within 0." in problems[-1]


@pytest.mark.parametrize(
    ("cards", "why"),
    [
        ({"CTYPE1": "RA---CAR", "CTYPE2": "DEC--CAR"}, "is no projection that a camera has"),
        ({"CD1_1": 0.0, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.0}, "singular"),
        ({"CUNIT1": "parsec", "CUNIT2": "parsec"}, ""),
        ({"CRVAL1": "here"}, "CRVAL1 is 'here', and not a number"),
        ({"CRVAL2": 1e300}, ""),
        ({"CRPIX1": 1e300}, ""),
        (
            {"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "A_ORDER": 2, "B_ORDER": 2}
            | {"A_2_0": 1e-3, "B_0_2": -2e-3},
            "no lens model follows",
        ),
    ],
)
def test_what_no_camera_does_costs_directions_but_no_frame(tmp_path, cards, why):
    write(tmp_path / "a.fits", header(83.6, 22.0, **cards))
    with open_recording(tmp_path / "a.fits") as recording:
        (frame,) = recording
        said = recording.problems[-1]
    assert (frame.camera, frame.attitudes) == (None, ())
    assert "a.fits and others like it have no directions: " in said
    assert why in said


@pytest.mark.parametrize("name", ["LINEAR", "RA", ""])
def test_only_what_names_the_sky_is_a_wcs(tmp_path, name):
    write(tmp_path / "a.fits", header(1.0, 2.0, CTYPE2=name, A_ORDER=2, A_2_0=1e-9))
    with open_recording(tmp_path / "a.fits") as recording:
        (frame,) = recording
        assert len(recording.problems) == 1
    assert frame.camera is None


def test_every_frame_has_its_own_attitude(tmp_path):
    for number in range(3):
        world = header(83.6 + number, 22.0)
        write(tmp_path / f"{number}.fits", world, f"2026-11-22T03:04:0{number}")
    with open_recording(tmp_path) as recording:
        frames = list(recording)
    for number, frame in enumerate(frames):
        ((stamp_ns, attitude),) = frame.attitudes
        ra, dec = np.degrees(to_radec([[0.0, 0.0, 1.0]], attitude))
        assert stamp_ns == frame.stamp_ns
        np.testing.assert_allclose([ra[0], dec[0]], [83.6 + number, 22.0], atol=1e-10)


def test_a_mirrored_image_among_others_has_no_directions(tmp_path):
    for number, mirrored in enumerate([True, False]):
        world = header(83.6, 22.0, mirrored=mirrored)
        write(tmp_path / f"{number}.fits", world, f"2026-11-22T03:04:0{number}")
    with open_recording(tmp_path) as recording:
        first, second = recording
        assert "it mirrors the sky, unlike" in recording.problems[-1]
    assert first.camera is not None
    assert second.camera is None
    # Both are turned over, as the first one's coordinates ask for.
    np.testing.assert_array_equal(first.image, second.image)
