# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pages on a night and on the archive: what they say, in a real browser."""

import html
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from archived import EVENING_NS, HOUR_NS, NAN, Seen, archived
from browser import PROGRAM, Browser
from command import ofsat, succeeds

from ofsat_ros.catalog import Catalog, Night
from ofsat_ros.report.archive import write_archive, write_night, write_pages
from ofsat_ros.report.night_line import Strip, strips_over_time
from ofsat_ros.report.sky_map import map_of_counts, map_of_paths

NIGHT = "2026-03-01"
BRIGHT = Seen(4, [(10 + 0.1 * i, 20) for i in range(20)], snr=40, flux=50_000)
FAST = Seen(1, [(11, 21 + 0.5 * i) for i in range(4)], snr=9, flux=800, rel=(30, 40))
NOWHERE = Seen(2, [(NAN, NAN)] * 5, snr=6, flux=90)
EVIL = '<script>console.error("bad")</script><img src=x onerror=alert(1)>'


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with pages on two nights: of two recordings and of one without a track."""
    out = tmp_path_factory.mktemp("out")
    folders = [
        archived(out / "results" / "dusk 1", [BRIGHT, NOWHERE], problems=["a gap of 5 s"]),
        archived(
            out / "results" / "dawn",
            [FAST],
            start_ns=EVENING_NS + 8 * HOUR_NS,
            blind=range(60, 120),
            stopped=True,
            left_out=3,
        ),
        archived(out / "results" / "later", start_ns=EVENING_NS + 30 * HOUR_NS),
    ]
    (folders[0] / "report.html").write_text("<h1>its own</h1>")
    with Catalog(out, write=True) as catalog:
        for folder in folders:
            catalog.add(folder)
        write_pages(catalog, out, {"/data/broken.bag": f"it holds no image {EVIL}"})
    return out


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "out"))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory):
    if not PROGRAM:
        pytest.skip("no Chromium is installed here: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("chromium")) as one:
        yield one


def words_of(page: Path) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page.read_text())).split())


def test_a_night_says_what_was_found(made: Path):
    words = words_of(made / "nights" / f"{NIGHT}.html")
    assert "3 tracks in 2 recordings" in words
    assert "Night of 2026-03-01 · noon to noon, UTC" in words
    assert (
        "The brightest, #4 of dusk 1.bag, has SNR 40 and instrumental magnitude \u221211.7."
        in words
    )
    # Half a degree a second.
    assert "fastest against the stars, #1 of dawn.bag, moves 50.0 px/s (1 800″/s)." in words
    assert "In 20 % of the frames no motion of stars was found: clouds, or too few stars" in words
    assert "dusk 1.bag : a gap of 5 s" in words
    assert (
        "dawn.bag : The run was stopped before the recording's end. · 3 frames could not be"
        " processed." in words
    )
    assert "1 of 3 tracks have no right ascension and declination: no attitude." in words
    assert "2 recordings ofsat_ros 0.1.0, preset robust" in words


def test_a_night_without_a_track_says_so(made: Path):
    page = made / "nights" / "2026-03-02.html"
    words = words_of(page)
    assert "No track in 1 recording" in words
    assert "Nothing was confirmed to move other than the stars." in words
    assert "<h2>Tracks</h2>" not in page.read_text()
    assert "On the sky" not in words


def test_links_lead_to_what_is_there(made: Path):
    night = (made / "nights" / f"{NIGHT}.html").read_text()
    links = set(re.findall(r'href="([^"#]+)(?:#[\w-]+)?"', night)) - {"data:,"}
    assert links == {"../results/dusk%201/report.html", "../report.html", "2026-03-02.html"}
    assert 'href="../results/dusk%201/report.html#track-4"' in night
    archive = (made / "report.html").read_text()
    assert {f"nights/{one}.html" for one in (NIGHT, "2026-03-02")} <= set(
        re.findall(r'href="([^"]+)"', archive)
    )
    assert 'href="results/dusk%201/report.html#track-4"' in archive


def test_the_archive_says_what_was_found_and_what_failed(made: Path):
    words = words_of(made / "report.html")
    assert "3 tracks in 2 nights" in words
    assert "3 recordings have results. 1 recording could not be processed." in words
    assert "Most tracks, 3, are of the night of 2026-03-01." in words
    assert "Not processed /data/broken.bag : it holds no image <script>" in words
    assert "Where 2 tracks begin, ICRS around 0h" in words
    order = re.search(r"Brightest.*?Fastest(.*?)Nights", words)
    assert order
    assert order[1].index("dawn.bag") < order[1].index("dusk 1.bag")


def test_an_empty_catalogue_has_a_page(tmp_path: Path):
    with Catalog(tmp_path, write=True) as catalog:
        write_pages(catalog, tmp_path)
    assert "No track in 0 nights" in words_of(tmp_path / "report.html")


def test_nights_by_the_sun_of_the_site_say_so(copy: Path):
    with Catalog(copy, write=True) as catalog:
        catalog.longitude_deg = -120.0
        (night, later) = catalog.nights()
        write_night(catalog, night, copy / "night.html")
        assert later == Night.parse("2026-03-02", -120.0)
    words = words_of(copy / "night.html")
    assert "mean solar time at longitude -120°: from 2026-03-01 20:00 UTC" in words


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 900)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_renders_without_complaints(
    browser: Browser, made: Path, width: int, height: int, scheme: str
):
    for page in (made / "nights" / f"{NIGHT}.html", made / "report.html"):
        browser.open(page, width, height, scheme)
        assert browser.complaints == []
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        ground = browser.screenshot()[2:20, 2:12].mean()
        assert ground > 230 if scheme == "light" else ground < 30
        small = "Math.min(...[...document.querySelectorAll('.line-of-time text')]"
        small += ".map(t => t.getBoundingClientRect().height))"
        assert browser.evaluate(small) > 9


def test_a_click_sorts(browser: Browser, made: Path):
    browser.open(made / "nights" / f"{NIGHT}.html", 1280, 900)
    heads = "document.querySelector('table.tracks').tHead.rows[0].cells"
    shown = "[...document.querySelector('table.tracks').tBodies[0].rows]"
    shown += ".map(r => r.cells[0].dataset.v)"
    assert browser.evaluate(shown) == ["4", "1", "2"]  # the brightest first
    for column, expected in ((3, ["4", "1", "2"]), (5, ["1", "4", "2"]), (9, ["1", "4", "2"])):
        browser.evaluate(f"{heads}[{column}].querySelector('button').click()")
        assert browser.evaluate(shown) == expected  # most first, unknown last
    browser.evaluate(f"{heads}[5].querySelector('button').click()")
    browser.evaluate(f"{heads}[5].querySelector('button').click()")
    assert browser.evaluate(shown) == ["4", "1", "2"]
    assert browser.complaints == []


def test_what_others_wrote_is_escaped(copy: Path, browser: Browser):
    folder = archived(
        copy / "results" / "evil<b>",
        [BRIGHT],
        recording=f"/x/{EVIL}",
        problems=[EVIL],
        preset=EVIL,
        unlocated={EVIL: 3},
    )
    with Catalog(copy, write=True) as catalog:
        catalog.add(folder)
        write_night(catalog, Night.parse(NIGHT), copy / "nights" / f"{NIGHT}.html")
        write_archive(catalog, copy / "report.html", {EVIL: EVIL})
    for page in (copy / "nights" / f"{NIGHT}.html", copy / "report.html"):
        browser.open(page, 1280, 900)
        assert browser.complaints == []
        assert browser.evaluate("document.images.length") == 0
        assert browser.evaluate("document.scripts.length") == 1


def test_the_command_writes_the_pages(copy: Path):
    for old in (*(copy / "nights").iterdir(), copy / "report.html"):
        old.unlink()
    assert "report.html and nights are in" in succeeds("catalog", copy, "--report").output
    names = {path.name for path in (copy / "nights").iterdir()}
    assert names == {f"{NIGHT}.html", "2026-03-02.html"}
    assert "3 tracks in 2 nights" in words_of(copy / "report.html")


def test_missing_jinja2_names_its_extra(copy: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    done = ofsat("catalog", copy, "--report")
    assert done.exit_code == 1
    assert "pip install 'ofsat_ros[report]'" in done.stderr


class TestSkyMaps:
    def places(self, svg: str) -> dict[str, np.ndarray]:
        found = re.findall(r'<path class="(c\d)" d="M([^"h]+)', svg)
        return {
            style: np.array(re.split("[L ]", path), float).reshape(-1, 2) for style, path in found
        }

    @pytest.mark.parametrize(("ra", "dec"), [(0.0, 0.0), (359.99, 60.0), (123.0, -89.5)])
    def test_north_is_up_and_east_left_right_across_0h(self, ra: float, dec: float):
        turn = 1 / np.cos(np.radians(dec))
        cross = {
            "c0": ([ra - turn / 9, ra + turn / 9], [dec, dec]),
            "c1": ([ra, ra], [dec - 0.1, dec + 0.1]),
        }
        paths = [(style, "", np.array(a) % 360, np.array(d)) for style, (a, d) in cross.items()]
        drawn = self.places(map_of_paths(paths, "two"))
        (west, *_, east), (south, *_, north) = drawn["c0"], drawn["c1"]
        assert west[0] > 200 > -200 > east[0]
        assert south[1] > 100 > -100 > north[1]
        assert abs(north[0] - south[0]) < 1
        # Distances from the middle are true: 1/9 and 1/10 of a degree, if not at the pole.
        if dec > -80:
            assert np.hypot(*east) / np.hypot(*north) == pytest.approx(10 / 9, rel=0.01)

    def test_all_round_the_sky(self):
        ra = np.arange(0, 360, 10.0)
        svg = map_of_paths([("c0", "", ra, np.zeros(36))], "a circle")
        assert np.hypot(*self.places(svg)["c0"].T).max() <= 301

    def test_counts(self):
        ra, dec = np.array([5.0, 5.5, 180.1, NAN]), np.array([0.5, 0.7, -89.0, 3])
        svg, most = map_of_counts(ra, dec, "three")
        assert most == 2
        assert sorted(map(int, re.findall(r"<title>(\d+)</title>", svg))) == [1, 2]
        cells = {
            int(many): np.array(re.split("[L ]", path), float).reshape(-1, 2).mean(0)
            for path, many in re.findall(r'd="M([^"]+)z"[^>]*><title>(\d+)', svg)
        }
        assert -20 < cells[2][0] < 0  # a little east of 0h: left of the middle
        assert cells[1][1] > 150  # south: down
        assert map_of_counts(ra[3:], dec[3:], "none") == ("", 0)


class TestNightLine:
    def stamps(self, *hours: float) -> np.ndarray:
        return EVENING_NS + (np.array(hours) * HOUR_NS).astype(np.int64)

    def test_bars_are_where_their_time_is(self):
        strip = Strip("A", "b", self.stamps(0, 3), self.stamps(1, 4), np.array([2.0, 4.0]))
        svg = strips_over_time([strip], "all")
        bars = re.findall(r"M([\d.]+) ([\d.]+)V([\d.]+)H([\d.]+)V", svg)
        (a0, base, top0, a1), (b0, _, top1, b1) = np.array(bars, float)
        assert [a0, b1] == pytest.approx([8, 992], abs=1.1)  # the whole width
        assert (a1 - a0) == pytest.approx(984 / 4, abs=1.1)
        assert b0 == pytest.approx(8 + 3 / 4 * 984, abs=0.1)
        assert (base - top1) == pytest.approx(2 * (base - top0))
        assert re.findall(r'class="t">([\d:]+)<', svg) == ["20:30", "21:00"] + [
            *("21:30", "22:00", "22:30", "23:00", "23:30")
        ]

    def test_what_overlaps_lies_beside_each_other(self):
        strip = Strip("A", "b", self.stamps(0, 0.5, 1.5), self.stamps(1, 1.4, 2))
        tops = re.findall(r"M[\d.]+ (\d+)H", strips_over_time([strip], "all"))
        assert tops[0] == tops[2] != tops[1]

    def test_lines_break_at_gaps(self):
        starts = self.stamps(0, 1, 2, 5, 6)
        strip = Strip("A", "b", starts, starts + HOUR_NS, np.array([1, 2, NAN, 3, 4.0]), line=True)
        path = re.search(r'class="line s0" d="([^"]+)"', strips_over_time([strip], "all"))
        assert path
        assert re.sub("[^ML]", "", path[1]) == "MLML"

    def test_dates_over_a_year(self):
        starts = self.stamps(*range(0, 24 * 365, 24))
        strip = Strip("A", "b", starts, starts + 24 * HOUR_NS, np.ones(365))
        shown = re.findall(r'class="t">([\d-]+)<', strips_over_time([strip], "all"))
        assert 4 <= len(shown) <= 9
        assert all(re.fullmatch(r"202[67]-\d\d-\d\d", one) for one in shown)

    def test_nothing_known_is_nothing_drawn(self):
        nothing = np.zeros(0, np.int64)
        assert strips_over_time([Strip("A", "b", nothing, nothing)], "all") == ""
        unknown = Strip("A", "b", self.stamps(0), self.stamps(1), np.array([NAN]))
        assert strips_over_time([unknown], "all") == ""
