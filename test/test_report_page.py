# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The report on a run: its page in a real browser, its film, and what both start from."""

import math
import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import PROGRAM, Browser
from command import fails, ofsat, succeeds

from ofsat_ros.recordings import BagWriter, RecordingError
from ofsat_ros.report import write_report, write_video
from ofsat_ros.report.findings import read_findings
from ofsat_ros.results import (
    DETECTION_COLUMNS,
    STAR_FIELD_COLUMNS,
    ResultError,
    read_run,
    write_run,
)
from ofsat_ros.simulation import scenario

TOPIC = "/camera/image_raw"
FRAMES, WIDTH, HEIGHT = 16, 200, 160
START_NS = 1_767_225_600_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder of results, RSOs that a mount follows, and their truth."""
    folder = tmp_path_factory.mktemp("run")
    sky = scenario("geo", 3, frames=FRAMES, width=WIDTH, height=HEIGHT)
    truth = []
    with BagWriter(folder / "night", compression="none") as bag:
        for frame in sky:
            bag.write_camera_info("/camera/camera_info", sky.camera, frame.stamp_ns, "camera")
            bag.write_attitude("/camera/attitude", frame.attitude, frame.stamp_ns, "camera")
            bag.write_image(TOPIC, frame.image, frame.stamp_ns, "camera")
            truth.append(frame.truth)
    succeeds("process", folder / "night", "-o", folder / "results", "--spot-sigmas", "4.5")
    return folder / "results", np.concatenate(truth)


@pytest.fixture
def results(run: tuple[Path, np.ndarray], tmp_path: Path) -> Path:
    """A copy of that folder, to be changed."""
    no_page = shutil.ignore_patterns("report.html")
    return Path(shutil.copytree(run[0], tmp_path / "results", ignore=no_page))


@pytest.fixture(scope="module")
def page(run: tuple[Path, np.ndarray]) -> Path:
    return write_report(run[0])


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory):
    if not PROGRAM:
        pytest.skip("no Chromium is installed here: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("chromium")) as one:
        yield one


def change(folder: Path, **changes: object) -> None:
    write_run(folder, read_run(folder) | changes)


def text_of(page: Path) -> str:
    """The page's words, without its pictures."""
    return re.sub(r'src="data:[^"]*"', "", page.read_text(encoding="utf-8"))


def test_sentence_says_what_was_found(page: Path, run: tuple[Path, np.ndarray]):
    count = len(np.unique(run[1]["id"]))
    words = text_of(page)
    assert f"<h1>{count} RSOs in {FRAMES} frames</h1>" in words
    lead = re.search(r'<p class="lead">(.*?)</p>', words)[1]
    assert re.search(r"The brightest, #\d+, has SNR \d+, moves [\d.]+ px a frame", lead)
    assert "is seen in every frame. The mount follows them: the stars drift" in lead


def test_page_needs_nothing_else(page: Path):
    words = text_of(page)
    assert "http" not in words.replace("https://", "http").replace("http-equiv", "")
    assert not re.search(r"<link[^>]*href=\"(?!data:)|@import|url\(", words)


def test_parameters_that_are_not_the_default_are_marked(page: Path):
    words = text_of(page)
    changed = re.search(r"not the default</h4>(.*?)</table>", words, re.DOTALL)[1]
    assert re.findall(r"<code>(\w+)</code></th><td>([\d.]+)", changed) == [("spot_sigmas", "4.5")]
    assert "-o results --topic /camera/image_raw" in words
    assert "--spot-sigmas 4.5" in words
    assert "<code>threshold_sigmas</code>" in words


def test_command_on_the_page_makes_the_same_results(page: Path, run, tmp_path: Path):
    command = re.search(r"<code>ofsat (process .*?)</code>", text_of(page))[1].split()
    command[command.index("-o") + 1] = f"{tmp_path / 'again'}"
    succeeds(*command)
    again, first = (
        (folder / "detections.csv").read_text() for folder in (tmp_path / "again", run[0])
    )
    assert again == first


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 900)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_renders_without_complaints(
    browser: Browser, page: Path, width: int, height: int, scheme: str
):
    browser.open(page, width, height, scheme)
    assert browser.complaints == []
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    unseen = "[...document.images].filter(i => !(i.complete && i.naturalWidth)).length"
    assert browser.evaluate(unseen) == 0
    ground = browser.screenshot()[2:20, 2:20].mean()
    assert ground > 230 if scheme == "light" else ground < 30
    # Words can be told from the ground, and none is smaller than eyes like.
    small = "Math.min(...[...document.querySelectorAll('.chart text')].slice(0, 9)"
    small += ".map(t => t.getBoundingClientRect().height))"
    assert browser.evaluate(small) > 9


def test_picture_is_the_right_one(browser: Browser, page: Path, run: tuple[Path, np.ndarray]):
    """Each RSO of the truth is a bright spot of the picture, within the ring that marks it."""
    browser.open(page, 1280, 1100)
    shown = browser.evaluate("document.querySelector('.view:not([hidden]) img').alt")
    assert shown.startswith("Sensor")  # the stars cross it, the RSOs stand still
    where = """(() => {
      const view = document.querySelector('.view:not([hidden])');
      const box = (e) => {
        const r = e.getBoundingClientRect();
        return [r.x, r.y, r.width, r.height];
      };
      return [box(view.querySelector('img')), [...view.querySelectorAll('.mark')].map(box)];
    })()"""
    browser.evaluate("document.getElementById('paths').click()")  # hides paths and rings
    bare = cv2.cvtColor(browser.screenshot(), cv2.COLOR_BGR2GRAY)
    browser.evaluate("document.getElementById('paths').click()")
    (left, top, width, height), marks = browser.evaluate(where)
    centres = np.array([(x + w / 2, y + h / 2) for x, y, w, h in marks])
    last = run[1][run[1]["frame"] == FRAMES - 1]
    scale = width / WIDTH
    assert height / HEIGHT == pytest.approx(scale, rel=1e-3)
    assert len(last) == len(marks) > 2
    for rso in last:
        expected = np.array([left, top]) + (np.array([rso["x_px"], rso["y_px"]]) + 0.5) * scale
        # Half a pixel of the image: an RSO of SNR 10 is measured so well with room to spare.
        assert np.hypot(*(centres - expected).T).min() < 0.5 * scale
        x, y = np.rint(expected).astype(int)
        around = bare[y - 40 : y + 41, x - 40 : x + 41]
        assert bare[y - 2 : y + 3, x - 2 : x + 3].min() > 2 * np.median(around)


def test_time_of_stages_adds_up(results: Path):
    profile = {"tracking": 0.32, "star_field": 0.16, "reading, meanwhile": 9.0}
    change(results, profile=profile, frames=FRAMES)
    words = text_of(write_report(results))
    assert "30.0 ms a frame, 33.3 frames a second" in words  # what runs beside them apart
    assert re.search(r"tracking</th>.*?<td>20.0 ms", words)


def test_buttons_change_what_is_shown(browser: Browser, page: Path):
    browser.open(page, 1280, 900)
    seen = "[...document.querySelectorAll('.view')].filter(v => v.offsetHeight).length"
    title = "document.querySelector('.view:not([hidden]) img').alt.split(':')[0]"
    names = []
    for i in range(3):
        browser.evaluate(f"document.querySelectorAll('button[data-view]')[{i}].click()")
        assert browser.evaluate(seen) == 1
        names.append(browser.evaluate(title))
    assert sorted(names) == ["Deep sky", "Movers", "Sensor"]
    wide = "document.querySelector('.view:not([hidden]) .frame').offsetWidth"
    before = browser.evaluate(wide)
    browser.evaluate("document.getElementById('large').click()")
    assert browser.evaluate(wide) > 1.5 * before
    assert browser.complaints == []


def test_every_track_has_its_gallery(browser: Browser, page: Path, run: tuple[Path, np.ndarray]):
    browser.open(page, 1280, 900)
    for number in np.unique(read_findings(run[0]).detections["track_id"]):
        card = f"document.getElementById('track-{number}')"
        assert browser.evaluate(f"{card}.querySelectorAll('.cuts img').length") == 1 + FRAMES
        assert browser.evaluate(f"{card}.querySelectorAll('svg.chart').length") == 4
    # In each mean the RSO is in the middle, and nothing else is as bright.
    middles = browser.evaluate("""Promise.all([...document.querySelectorAll('.mean img')].map(
      async (image) => {
        const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
        const pen = canvas.getContext('2d');
        pen.drawImage(image, 0, 0);
        const {data, width} = pen.getImageData(0, 0, canvas.width, canvas.height);
        let best = 0;
        for (let i = 0; i < data.length; i += 4) if (data[i] > data[best]) best = i;
        return [best / 4 % width, Math.floor(best / 4 / width), width];
      }))""")
    assert all(abs(x - w // 2) <= 1 and abs(y - w // 2) <= 1 for x, y, w in middles)


def test_what_others_wrote_is_escaped(results: Path, browser: Browser):
    evil = '<script>console.error("bad")</script><img src=x onerror=alert(1)>'
    change(results, problems=[evil], topic=evil, preset=evil, recording=f"/nowhere/{evil}")
    rows = (results / "star_field.csv").read_text().splitlines()
    assert '"' in rows[-1]
    rows[-1] = rows[-1].split('"')[0] + f'"{evil.replace(chr(34), "")}"'
    (results / "star_field.csv").write_text("\n".join(rows) + "\n")
    page = write_report(results)
    browser.open(page, 1280, 900)
    assert browser.complaints == []
    assert "onerror" in browser.evaluate("document.querySelector('.notes').textContent")
    assert browser.evaluate("document.images.length") == 0


def test_recording_that_is_gone_costs_the_pictures_only(results: Path):
    change(results, recording="/nowhere/night")
    said: list[str] = []
    words = text_of(write_report(results, say=said.append))
    assert "No pictures: the recording is not at /nowhere/night: say where it is" in words
    (note,) = said  # also to those who only see a terminal
    assert note.startswith("note: report.html has no pictures: the recording is not at")
    assert "<img" not in words
    assert words.count('class="chart"') > 8


def test_recording_that_moved_is_found_where_one_says(results: Path, run):
    change(results, recording="/nowhere/night")
    assert "<img" in text_of(write_report(results, run[0].parent / "night"))


def test_another_recording_is_refused(results: Path, tmp_path: Path):
    (first_ns, *_) = read_findings(results).frames["stamp_ns"].tolist()
    page = write_report(results)
    before = page.read_bytes()
    for name, stamp_ns, says in (
        ("later", first_ns + 10**9, "or was changed: its frame 0 is of 2026-01-01 00:00:02.000"),
        ("smaller", first_ns, f"it has no images of {WIDTH}x{HEIGHT}"),
    ):
        with BagWriter(tmp_path / name) as bag:
            bag.write_image(TOPIC, np.zeros((40, 50), np.uint16), stamp_ns, "camera")
        with pytest.raises(RecordingError, match=f"{name} is another recording.*{says}"):
            write_report(results, tmp_path / name)
        # What is not what was asked for does not take the place of what is.
        assert page.read_bytes() == before
        change(results, recording=f"{tmp_path / name}")
        assert says in fails(1, "report", results, "--video", tmp_path / "night.gif")
        page.write_bytes(before)
    assert not (tmp_path / "night.gif").exists()


def processed(folder: Path, images: list[np.ndarray], step_ns: int = 10**9) -> Path:
    """Make a recording of images, and results of it."""
    with BagWriter(folder / "night", compression="none") as bag:
        for i, image in enumerate(images):
            bag.write_image(TOPIC, image, START_NS + i * step_ns, "camera")
    succeeds("process", folder / "night", "-o", folder / "results")
    return folder / "results"


def images_of(name: str, seed: int, frames: int, **size: int) -> list[np.ndarray]:
    settings = {"frames": frames, "width": 160, "height": 120} | size
    return [frame.image for frame in scenario(name, seed, **settings)]


def alts(words: str) -> list[str]:
    """What the pictures of the sky are said to show."""
    return re.findall(r'<img[^>]*? alt="((?:Deep sky|Movers|Sensor|Frame): .*?)"', words)


def test_frames_of_another_size_are_left_out_of_the_pictures(tmp_path: Path):
    images = images_of("geo", 3, 9)
    images[2] = images[2][:100]  # first there are two frames, then six
    results = processed(tmp_path, images)
    run = read_run(results)
    assert (run["width"], run["height"]) == (160, 120)
    words = text_of(write_report(results))
    assert any("the mean of 6 frames" in alt for alt in alts(words))
    # What was before the break is not drawn on the stars after it.
    findings = read_findings(results)
    inside = [track for track in findings.tracks if findings.is_in_main_stretch(track)]
    assert inside
    assert words.count('class="mark') == len(inside) * len(alts(words))
    if others := len(findings.tracks) - len(inside):
        assert f"{others} RSO" in words


def test_pixels_that_are_missing_cost_no_picture(tmp_path: Path):
    random = np.random.default_rng(1)
    images = [image.astype(np.float32) for image in images_of("survey", 1, 6)]
    for image in images:
        image[random.random(image.shape) < 0.2] = np.nan
        image[:, -20:] = np.inf
    words = text_of(write_report(processed(tmp_path, images)))
    assert {alt.split(":")[0] for alt in alts(words)} >= {"Deep sky", "Movers"}


def test_stamps_that_are_all_the_same_are_told_in_few_words(tmp_path: Path):
    results = processed(tmp_path, images_of("empty", 1, 12), step_ns=0)
    words = text_of(write_report(results))
    assert words.count("left out, and others like it: it has the same stamp as the frame") == 1
    assert "<dt>between frames</dt><dd>\u2013 s</dd>" in words
    assert alts(words) == ["Frame: a single frame: there is no other to lay on it"]


def test_frames_that_all_start_afresh_are_told_in_few_words(tmp_path: Path):
    results = processed(tmp_path, images_of("empty", 1, 12), step_ns=700 * 10**9)
    words = text_of(write_report(results))
    assert words.count("starts afresh: a gap of 700 s is longer than max_gap_s") == 5
    assert "6 more frames start afresh: star_field.csv says why" in words


def test_sky_without_rso_says_why(tmp_path: Path):
    processed(tmp_path, images_of("empty", 1, 6))
    words = text_of(write_report(tmp_path / "results"))
    assert "<h1>No RSO in 6 frames</h1>" in words
    assert re.search(r'"lead">The last frame says: \d+ stars; .*</p>', words)
    assert "Deep sky" in words
    assert "<h2>Tracks</h2>" not in words


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        (1, "A single frame shows no motion: three at least are needed"),
        (2, "An RSO is known as such in its third frame at the earliest: there are two."),
    ],
)
def test_few_frames_say_what_is_missing(tmp_path: Path, frames: int, says: str):
    assert says in text_of(write_report(processed(tmp_path, images_of("geo", 1, frames))))


def test_page_of_a_long_night_is_light(results: Path, tmp_path: Path):
    """500 frames full of RSOs, more than are shown one by one."""
    frames, tracks, size = 500, 60, 160
    random = np.random.default_rng(1)
    stamps = START_NS + np.arange(frames) * 10**9
    with BagWriter(tmp_path / "night", compression="none") as bag:
        for stamp in stamps.tolist():
            image = random.integers(80, 120, (size, size), np.uint8)
            bag.write_image(TOPIC, image, stamp, "camera")
    field = [",".join(STAR_FIELD_COLUMNS)]
    found = [",".join(DETECTION_COLUMNS)]
    places = random.uniform(30, 130, (tracks, 2))
    for frame, stamp in enumerate(stamps.tolist()):
        dt_s = "1" if frame else "nan"
        field.append(
            f"{stamp},{frame},{dt_s},0.4,0.1,0.4,0.1,0,0,0.01,0.01,0.2,300,400,60,100,4,16,"
        )
        numbers = random.normal([0, 0, 10, 10, 10], [0.2, 0.2, 1, 1, 1], (tracks, 5))
        numbers[:, :2] += places
        for track, (x, y, snr, flux, length) in enumerate(numbers.tolist(), 1):
            found.append(
                f"{stamp},{frame},{track},1,{x},{y},0.1,0.1,-0.3,0.01,0.2,0.2,{snr},{flux},{length},0,0,0"
            )
    (results / "star_field.csv").write_text("\n".join(field) + "\n")
    (results / "detections.csv").write_text("\n".join(found) + "\n")
    night = f"{tmp_path / 'night'}"
    change(results, recording=night, width=size, height=size, frames=frames)
    page = write_report(results)
    assert "60 RSOs in 500 frames" in text_of(page)
    assert text_of(page).count("<article") == 40
    assert 1_000_000 < page.stat().st_size < 10_000_000


def test_line_that_was_cut_off_is_left_out(results: Path):
    path = results / "detections.csv"
    path.write_text(path.read_text()[:-40])
    whole = len(path.read_text().splitlines()) - 2
    assert len(read_findings(results).detections) == whole


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("detections.csv", "a,b\n1,2\n", "detections.csv has other columns"),
        ("star_field.csv", None, "holds no star_field.csv"),
        ("run.json", None, r"holds no run\.json"),
        ("run.json", "{", r"run\.json is damaged"),
        ("run.json", '{"width": "200"}', r"run\.json is damaged: width is '200'"),
        ("run.json", '{"profile": {"tracking": "1"}}', r"run\.json is damaged: profile"),
        ("run.json", '{"recording": [1]}', r"run\.json is damaged: recording is \[1\]"),
    ],
)
def test_folders_that_are_no_results(results: Path, name: str, text: str | None, says: str):
    (results / name).unlink() if text is None else (results / name).write_text(text)
    with pytest.raises(ResultError, match=says):
        write_report(results)
    assert not (results / "report.html").exists()


def test_a_run_that_tells_nothing_is_enough_for_words(results: Path):
    (results / "run.json").write_text("{}")
    words = text_of(write_report(results))
    assert f"RSOs in {FRAMES} frames</h1>" in words
    assert "No pictures: the recording is not at ?" in words


def test_times_that_make_no_sense_are_named(results: Path):
    change(results, parameters={"stamp_offset_s": "late"})
    with pytest.raises(ResultError, match=r"run\.json is damaged: stamp_offset_s"):
        write_report(results)


def test_garbage_at_the_end_of_a_table_is_left_out(results: Path):
    before = read_findings(results)
    with (results / "star_field.csv").open("ab") as file:
        file.write(b"1767\xff\xfe\x00\x00")
    after = read_findings(results)
    np.testing.assert_array_equal(after.frames["stamp_ns"], before.frames["stamp_ns"])
    assert after.frames["note"][-1] == before.frames["note"][-1]


def test_a_cell_that_is_no_number_is_named(results: Path):
    path = results / "detections.csv"
    path.write_text(path.read_text().replace(",1,1,", ",1,one,", 1))
    with pytest.raises(ResultError, match=r"detections\.csv is damaged.*one"):
        write_report(results)


def test_stars_stand_still_on_the_sky(run: tuple[Path, np.ndarray]):
    """The chain of motions takes the RSOs, which stand on the sensor, evenly over the sky."""
    findings = read_findings(run[0])
    assert len(findings.tracks) == len(np.unique(run[1]["id"]))
    for track in findings.tracks:
        truth = run[1][
            (run[1]["frame"] == 0)
            & (
                np.hypot(run[1]["x_px"] - track.places[0, 0], run[1]["y_px"] - track.places[0, 1])
                < 2
            )
        ]
        steps = np.diff(track.sky, axis=0) / np.diff(track.seconds)[:, None]
        expected = truth["rel_vx_px_s"][0] if "rel_vx_px_s" in truth.dtype.names else None
        rows = track.rows
        mean = rows["rel_vx_px_s"].mean(), rows["rel_vy_px_s"].mean()
        # Motion of the field is known to some 0.02 px a frame here; 16 of them even out.
        assert steps.mean(0) == pytest.approx(mean, abs=0.02)
        assert expected is None or mean[0] == pytest.approx(expected, abs=0.05)
        # Their positions are as good as they say: 16 of each axis tell a std to 20 %.
        sigma = math.sqrt(np.mean((rows["sigma_x_px"] ** 2 + rows["sigma_y_px"] ** 2) / 2))
        assert 0.5 * sigma < track.smooth.rms < 1.7 * sigma


def test_video_shows_each_frame_and_its_rsos(run: tuple[Path, np.ndarray], tmp_path: Path):
    film = write_video(run[0], tmp_path / "night.mp4")
    video = cv2.VideoCapture(str(film))
    shown = []
    while (frame := video.read())[0]:
        shown.append(frame[1])
    assert len(shown) == FRAMES
    zoom = shown[0].shape[1] / WIDTH
    assert shown[0].shape[0] / HEIGHT == pytest.approx(zoom, rel=0.01)
    for number in (0, FRAMES - 1):  # final ids: from the first frame on
        red = shown[number][..., 2].astype(int) - shown[number][..., 1] > 40
        for rso in run[1][run[1]["frame"] == number]:
            x, y = (round(float(rso[name] + 0.5) * zoom) for name in ("x_px", "y_px"))
            half = round(13 * zoom)
            assert red[max(y - half, 0) : y + half, max(x - half, 0) : x + half].sum() > 20


def test_video_plays_in_a_browser(browser: Browser, run, tmp_path: Path):
    film = write_video(run[0], tmp_path / "night.mp4")
    holder = tmp_path / "holder.html"
    holder.write_text(f"<video muted src='{film.name}'></video>")
    browser.open(holder, 800, 600)
    played = browser.evaluate("""new Promise((done) => {
      const video = document.querySelector('video');
      video.onended = () => done([video.videoWidth, video.duration]);
      video.onerror = () => done(video.error.message);
      video.playbackRate = 4;
      video.play().catch((error) => done(`${error}`));
    })""")
    assert played[0] >= WIDTH
    assert played[1] == pytest.approx(FRAMES / 8, rel=0.05)  # the slowest that eyes like


def test_gif_shows_each_frame(run: tuple[Path, np.ndarray], tmp_path: Path):
    from PIL import Image

    with Image.open(write_video(run[0], tmp_path / "night.gif")) as film:
        assert film.n_frames == FRAMES
        assert film.info["duration"] == 120  # a GIF counts hundredths of a second
        film.seek(FRAMES - 1)
        red, green, _ = np.moveaxis(np.asarray(film.convert("RGB")).astype(int), 2, 0)
    assert np.count_nonzero(red - green > 40) > 100


def test_names_of_videos(run: tuple[Path, np.ndarray], tmp_path: Path):
    with pytest.raises(ResultError, match=r"night\.avi: a video is a file whose name ends in"):
        write_video(run[0], tmp_path / "night.avi")


@pytest.mark.parametrize(("package", "suffix"), [("jinja2", ""), ("av", ".mp4"), ("PIL", ".gif")])
def test_missing_package_names_its_extra(
    results: Path, monkeypatch: pytest.MonkeyPatch, package: str, suffix: str
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ofsat_ros\[report\]'"):
        write_video(results, results / f"a{suffix}") if suffix else write_report(results)
    assert not list(results.glob("*.part")) + list(results.glob(".*.part"))


def test_command(results: Path, tmp_path: Path):
    done = succeeds("report", results, "--video", tmp_path / "night.gif")
    assert done.stdout == f"{results / 'report.html'} and {tmp_path / 'night.gif'} are written\n"
    refused = fails(1, "report", results, "--video", tmp_path / "night.gif")
    assert "exists: choose another name, or --force" in refused
    assert "there is nothing at" in fails(1, "report", results, "--recording", tmp_path / "no")
    assert "holds no run.json" in fails(1, "report", tmp_path)


def test_stopped_command_says_what_there_is(results: Path, tmp_path: Path, monkeypatch):
    def stopped(*_: object) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr("ofsat_ros.cli.report.write_video", stopped)
    page = results / "report.html"
    done = ofsat("report", results, "--video", tmp_path / "night.gif")
    assert (done.exit_code, done.stdout) == (130, "")
    assert done.stderr == f"stopped; {page} is written\n"
    monkeypatch.setattr("ofsat_ros.cli.report.write_report", stopped)
    assert ofsat("report", results).stderr == "stopped; nothing is written\n"
