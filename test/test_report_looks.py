# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pictures of the report: what stands still in them, what is gone, and where things lie."""

import json
from pathlib import Path

import numpy as np
import pytest

from ofsat_ros.report.findings import Findings, read_findings
from ofsat_ros.report.looks import CutOuts, Sky, View
from ofsat_ros.results import DETECTION_COLUMNS, STAR_FIELD_COLUMNS, write_run

WIDTH, HEIGHT, FRAMES = 120, 90, 20
CENTRE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
# Of the stars from frame to frame: px, rad.
SHIFT, TURN = np.array([-4.0, 1.5]), 0.004
STARS = np.array([(70.0, 40.0), (90.0, 30.0), (80.0, 60.0)])
RSO, HOT = np.array([30.25, 25.5]), (85, 70)  # a place; a pixel (x, y)
NOISE, LEVEL = 2.0, 100.0


def stars_at(frame: int) -> np.ndarray:
    """Where the stars are: each place is that before, moved as StarFieldMotion says."""
    places = STARS
    back = np.eye(2) - np.array([[0, -TURN], [TURN, 0]])
    for _ in range(frame):  # places = before + shift + A (places - centre)
        places = np.linalg.solve(back, (places - CENTRE + SHIFT).T).T + CENTRE
    return places


def image_of(frame: int) -> np.ndarray:
    random = np.random.default_rng(frame)
    image = random.normal(LEVEL, NOISE, (HEIGHT, WIDTH))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for place in (*stars_at(frame), RSO):
        image += 60 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 2)
    image[HOT[1], HOT[0]] += 80
    return image.astype(np.float32)


@pytest.fixture(scope="module")
def findings(tmp_path_factory: pytest.TempPathFactory) -> Findings:
    folder = tmp_path_factory.mktemp("results")
    field, found = [STAR_FIELD_COLUMNS], [DETECTION_COLUMNS]
    for frame in range(FRAMES):
        stamp = 10**18 + frame * 10**9
        move = [1.0, *SHIFT, *SHIFT, np.degrees(TURN)] if frame else [np.nan] * 6
        rest = [0, 0.01, 0.01, 0.1, 3, 5, 1, LEVEL, NOISE / 3, 3, ""]
        field.append((stamp, frame, *move, *rest))
        rel = -SHIFT
        row = [*RSO, 0, 0, *rel, 0.1, 0.1, 20, 400, 0, 0, np.nan, np.nan]
        found.append((stamp, frame, 7, 1, *row))
    for name, rows in (("star_field.csv", field), ("detections.csv", found)):
        (folder / name).write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    write_run(folder, json.loads(f'{{"width": {WIDTH}, "height": {HEIGHT}, "frames": {FRAMES}}}'))
    return read_findings(folder)


@pytest.fixture(scope="module")
def views(findings: Findings) -> dict[str, View]:
    sky = Sky(findings)
    for frame in range(FRAMES):
        sky.add(findings.row_of[frame], image_of(frame))
    return {view.name: view for view in sky.views()}


def brightness(view: View, place: np.ndarray) -> float:
    """The brightest pixel within one px of the sensor around a place."""
    x, y = view.from_place[:, :2] @ place + view.from_place[:, 2]
    zoom = view.from_place[0, 0]
    half = max(round(zoom), 1)
    x, y = round(float(x)), round(float(y))
    return float(view.picture[y - half : y + half + 1, x - half : x + half + 1].max())


def background(view: View) -> float:
    return float(np.median(view.picture[view.picture > 0]))


def test_the_view_that_says_most_comes_first(views: dict[str, View]):
    assert list(views) == ["Sensor", "Deep sky", "Movers"]  # the RSO stands still on the sensor


@pytest.mark.parametrize("name", ["Deep sky", "Movers"])
def test_stars_stand_still_on_the_sky(views: dict[str, View], name: str):
    view = views[name]
    for star in STARS:
        assert brightness(view, star) > background(view) + 100


def test_a_star_is_as_sharp_in_the_deep_sky_as_in_a_frame(views: dict[str, View]):
    """Centroid and width of a star in the mean of frames that shift and turn."""
    view = views["Deep sky"]
    zoom = view.from_place[0, 0]
    x, y = view.from_place[:, :2] @ STARS[0] + view.from_place[:, 2]
    half = round(4 * zoom)
    left, top = round(float(x)) - half, round(float(y)) - half
    cut = view.picture[top : top + 2 * half + 1, left : left + 2 * half + 1].astype(float)
    weight = np.clip(cut - np.median(cut) - 25, 0, None)
    rows, columns = np.mgrid[: len(cut), : len(cut)]
    centre = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    # A quarter of a pixel of the sensor: the stretch and the noise shift it, not the chain.
    assert centre + (left, top) == pytest.approx([x, y], abs=0.25 * zoom)
    # Above half its stretched height it is about 3 px wide; smeared stars would be longer.
    assert np.count_nonzero(cut > cut.max() / 2) < np.pi * (2.7 * zoom) ** 2


def test_pixels_that_are_always_bright_leave_no_trail(views: dict[str, View], findings: Findings):
    at = findings.to_sky @ np.array([*HOT, 1.0])
    for name in ("Deep sky", "Movers"):
        trail = [brightness(views[name], place[:2]) for place in at]
        assert np.median(trail) < background(views[name]) + 60


def test_movers_leave_trails(views: dict[str, View], findings: Findings):
    (track,) = findings.tracks
    trail = [brightness(views["Movers"], place) for place in track.sky]
    assert min(trail) > background(views["Movers"]) + 100


def test_sensor_shows_what_the_mount_follows(views: dict[str, View], findings: Findings):
    view = views["Sensor"]
    assert brightness(view, RSO) > background(view) + 100
    crossed = [brightness(view, star) for star in STARS]
    assert max(crossed) < brightness(view, RSO) / 2
    zoom = view.from_place[0, 0]
    path = view.paths(findings.tracks[0])
    assert path == pytest.approx(np.tile((RSO + 0.5) * zoom - 0.5, (FRAMES, 1)))


def test_cut_outs_hold_the_track_in_their_middle(findings: Findings):
    cuts = CutOuts(findings.tracks)
    for frame in range(FRAMES):
        cuts.add(frame, image_of(frame))
    gallery = cuts.galleries()[7]
    assert gallery.count == FRAMES
    assert [number for number, _ in gallery.cuts][:1] == [0]
    assert gallery.cuts[-1][0] == FRAMES - 1
    for picture in (gallery.mean, *(cut for _, cut in gallery.cuts)):
        middle = len(picture) // 2
        peak = np.unravel_index(
            picture[middle - 5 : middle + 6, middle - 5 : middle + 6].argmax(), (11, 11)
        )
        assert np.abs(np.array(peak) - 5).max() <= 1


def test_cut_outs_at_the_border_are_dark_beyond_it(findings: Findings):
    (track,) = findings.tracks
    rows = track.rows.copy()
    rows["x_px"], rows["y_px"] = 2.0, 1.0
    edge = type(track)(track.number, rows, track.sky, track._turns)
    cuts = CutOuts([edge])
    cuts.add(0, image_of(0))
    (_, cut), *_ = cuts.galleries()[7].cuts
    assert not cut[:, : len(cut) // 2 - 2].any()
    assert cut[len(cut) // 2 + 1 :, len(cut) // 2 :].any()


def test_frames_after_a_break_are_another_stretch(findings: Findings, tmp_path: Path):
    for name in ("star_field.csv", "detections.csv", "run.json"):
        (tmp_path / name).write_bytes((findings.folder / name).read_bytes())
    lines = (tmp_path / "star_field.csv").read_text().splitlines()
    cells = lines[6].split(",")  # frame 5
    lines[6] = ",".join([*cells[:2], *["nan"] * 6, *cells[8:]])
    (tmp_path / "star_field.csv").write_text("\n".join(lines) + "\n")
    broken = read_findings(tmp_path)
    assert broken.stretch.tolist() == [0] * 5 + [1] * (FRAMES - 5)
    assert broken.main_stretch.tolist() == list(range(5, FRAMES))
    # Where stars were not found though there was a frame before, the motion goes on.
    lines[6] = ",".join([*cells[:3], *["nan"] * 5, *cells[8:]])
    (tmp_path / "star_field.csv").write_text("\n".join(lines) + "\n")
    assert read_findings(tmp_path).to_sky == pytest.approx(findings.to_sky)
