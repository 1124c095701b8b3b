# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pages on many recordings: one for a night, and one for all nights of a catalogue.

The last step of ``ofsat batch``, and of ``ofsat catalog --report``.  All that they say is in the
catalogue; each recording's own page, to which they lead, shows pictures.  The archive's page is
``report.html`` in a folder, a night's ``nights/YYYY-MM-DD.html`` there.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.catalog import Catalog, Night, Result, Selection
from ofsat_ros.report import words
from ofsat_ros.report.html import REPORT
from ofsat_ros.report.night_line import Strip, strips_over_time
from ofsat_ros.report.sky_map import map_of_counts, map_of_paths
from ofsat_ros.report.template import page_template
from ofsat_ros.results import write_whole

NIGHTS = "nights"

_Rows = NDArray[np.void]
_MINUTE_NS = 60 * 1_000_000_000
_COLOURS = 8
# Tracks in a night's table and on its map, and in each of the archive's.
_LISTED, _BEST = 300, 12
# The RSOs of a night are counted in so many parts of its time.
_PARTS = 96
# More frames than this part without a motion of the stars are worth a sentence.
_CLOUDY = 0.05


def write_pages(catalog: Catalog, folder: Path, failed: Mapping[str, str] | None = None) -> None:
    """Write the archive's page and all nights' into a folder; arguments as of `write_archive`."""
    (folder / NIGHTS).mkdir(parents=True, exist_ok=True)
    for night in catalog.nights():
        write_night(catalog, night, folder / NIGHTS / f"{night}.html")
    write_archive(catalog, folder / REPORT, failed)


def write_night(catalog: Catalog, night: Night, path: Path) -> None:
    """Write the page on the recordings that begin in a night.

    Parameters
    ----------
    catalog : Catalog
    night : Night
    path : Path
        The file; an older one is replaced.  Its links lead to other nights' pages beside it, and
        to the archive's page in the folder above.

    Raises
    ------
    ModuleNotFoundError
        If jinja2 is missing.
    CatalogError
        If the catalogue cannot be read.
    OSError
        If the page cannot be written.
    """
    template = page_template("night.html")
    results = catalog.results(night)
    tracks = catalog.query(_of(night), sort="flux", descending=True)
    minutes = catalog.minutes(results)
    reports = {one.id: _report_of(one, path) for one in results}
    nights = catalog.nights()
    before = [one for one in nights if one < night]
    after = [one for one in nights if one > night]
    shown = tracks[:_LISTED]
    page = template.render(
        **_headline(tracks, results),
        lead=_lead(tracks, minutes),
        title=f"Night of {night}",
        span=_span(catalog, night),
        **{"before": before[-1:], "after": after[:1], "above": f"../{REPORT}"},
        facts=_facts(tracks, results),
        notes=_notes(results),
        no_directions=_no_directions(tracks, results),
        sky=_sky(catalog, shown, reports),
        line=_night_line(tracks, results, minutes),
        tracks=_listed(shown, reports),
        unlisted=len(tracks) - len(shown),
        recordings=[
            _recording(one, minutes[minutes["result"] == one.id], reports[one.id])
            for one in results
        ],
        made=_made(results),
    )
    write_whole(path, page, "replace")


def write_archive(catalog: Catalog, path: Path, failed: Mapping[str, str] | None = None) -> None:
    """Write the page on all nights.

    Parameters
    ----------
    catalog : Catalog
    path : Path
        The file; an older one is replaced.  Its links lead to the nights' pages in ``nights/``.
    failed : mapping of str to str, optional
        Recordings without a result, and why.

    Raises
    ------
    ModuleNotFoundError
        If jinja2 is missing.
    CatalogError
        If the catalogue cannot be read.
    OSError
        If the page cannot be written.
    """
    template = page_template("archive.html")
    nights = [_night(catalog, night) for night in catalog.nights()]
    results = catalog.results()
    reports = {one.id: _report_of(one, path) for one in results}
    ra, dec = (
        np.concatenate([np.zeros(0), *(one[name] for one in nights)]) for name in ("ra", "dec")
    )
    sky, most = map_of_counts(ra, dec, f"where on the sky {len(ra)} tracks begin")
    best = [
        (name, legend, _listed(catalog.query(sort=sort, descending=down, limit=_BEST), reports))
        for name, legend, sort, down in (
            ("Brightest", "highest flux first", "flux", True),
            ("Fastest", "against the stars", "rate_px_s", True),
        )
    ]
    page = template.render(
        **_archive_headline(nights, results, failed or {}),
        span=_span(catalog),
        nights=nights,
        failed=sorted((failed or {}).items()),
        **{"sky": sky, "most": most, "located": len(ra)},
        line=_archive_line(nights),
        best=[one for one in best if one[2]],
        made=_made(results),
    )
    write_whole(path, page, "replace")


def _of(night: Night) -> Selection:
    return Selection(began=(night.first_ns, night.end_ns))


def _report_of(result: Result, page: Path) -> str:
    """Where a page links to for a result's own; empty if it has none."""
    report = result.folder / REPORT
    if not report.is_file():
        return ""
    way = Path(os.path.relpath(report.resolve(), page.resolve().parent))
    # Escaped as in an address, and relative again.
    return Path("/", way).as_uri().removeprefix("file:///")


def _span(catalog: Catalog, night: Night | None = None) -> str:
    """Say from when to when a night is."""
    longitude = catalog.longitude_deg
    by = "UTC" if longitude is None else f"mean solar time at longitude {longitude:g}\u00b0"
    if night is None:
        return f"Nights are from noon to noon, {by}"
    return f"noon to noon, {by}" + (
        f": from {words.instant(night.first_ns)[:16]} UTC" if longitude is not None else ""
    )


def _headline(tracks: _Rows, results: list[Result]) -> dict[str, str]:
    found = words.count(len(tracks), "track") if len(tracks) else "No track"
    return {"headline": f"{found} in {words.count(len(results), 'recording')}"}


def _lead(tracks: _Rows, minutes: _Rows) -> str:
    said = []
    if len(tracks):
        one = tracks[0]
        said.append(
            f"The brightest, #{one['track_id']} of {one['recording']}, has SNR"
            f" {words.number(one['snr'], 2)} and instrumental magnitude"
            f" {words.number(one['magnitude'])}."
        )
    if np.isfinite(tracks["rate_px_s"]).any():
        one = tracks[np.nanargmax(tracks["rate_px_s"])]
        said.append(
            f"The fastest against the stars, #{one['track_id']} of {one['recording']}, moves"
            f" {_rate(one)}."
        )
    frames, blind = int(minutes["frames"].sum()), int(minutes["blind"].sum())
    if frames and blind > _CLOUDY * frames:
        said.append(
            f"In {100 * blind / frames:.0f} % of the frames no motion of stars was found: clouds,"
            " or too few stars."
        )
    if not len(tracks):
        said.append("Nothing was confirmed to move other than the stars.")
    return " ".join(said)


def _rate(track: np.void) -> str:
    rate = f"{words.number(track['rate_px_s'])} px/s"
    if np.isfinite(track["rate_arcsec_s"]):
        rate += f" ({words.number(track['rate_arcsec_s'])}\u2033/s)"
    return rate


def _facts(tracks: _Rows, results: list[Result]) -> list[tuple[str, str]]:
    return [
        ("recordings", f"{len(results)}"),
        ("frames", words.number(sum(one.frames for one in results), 1)),
        ("recorded", words.duration(_recorded_s(results))),
        ("tracks with directions", f"{int(np.isfinite(tracks['first_ra_deg']).sum())}"),
    ]


def _recorded_s(results: list[Result]) -> float:
    return sum(one.last_stamp_ns - one.first_stamp_ns for one in results) / 1e9


def _notes(results: list[Result]) -> list[tuple[str, list[str]]]:
    """What each recording's run has noted."""
    noted = []
    for one in results:
        said = ["The run was stopped before the recording's end."] * one.stopped
        if one.left_out:
            said.append(f"{words.count(one.left_out, 'frame')} could not be processed.")
        said += one.problems
        noted.append((one.name, said))
    return [each for each in noted if each[1]]


def _no_directions(tracks: _Rows, results: list[Result]) -> str:
    """Say why some tracks are on no map; empty if all are."""
    missing = int(np.isnan(tracks["first_ra_deg"]).sum())
    if not missing:
        return ""
    reasons: Counter[str] = Counter()
    for one in results:
        reasons.update(one.unlocated)
    why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
    of = "it has" if len(tracks) == 1 else f"{missing} of {len(tracks)} tracks have"
    return f"{of[0].upper()}{of[1:]} no right ascension and declination{why}."


def _sky(catalog: Catalog, tracks: _Rows, reports: dict[int, str]) -> str:
    places = catalog.paths(tracks)
    paths = []
    for i, track in enumerate(tracks):
        own = places[
            (places["result"] == track["result"]) & (places["track_id"] == track["track_id"])
        ]
        if len(own):
            paths.append((_style(i), _link(track, reports), own["ra_deg"], own["dec_deg"]))
    return map_of_paths(paths, f"paths of {len(paths)} tracks on the sky")


def _style(index: int) -> str:
    return f"c{index % _COLOURS}"


def _link(track: np.void, reports: dict[int, str]) -> str:
    report = reports[int(track["result"])]
    return f"{report}#track-{track['track_id']}" if report else ""


def _night_line(tracks: _Rows, results: list[Result], minutes: _Rows) -> str:
    span = {one.id: (one.first_stamp_ns, one.last_stamp_ns) for one in results}
    firsts, lasts = np.array(list(span.values()), np.int64).T
    # Of the first and the last minute of a recording, what is its own.
    of = [span[number] for number in minutes["result"].tolist()]
    first, last = np.array(of, np.int64).reshape(-1, 2).T
    starts = np.maximum(minutes["start_ns"], first)
    ends = np.maximum(np.minimum(minutes["start_ns"] + _MINUTE_NS, last), starts)
    blind = 100 * minutes["blind"] / np.maximum(minutes["frames"], 1)
    fresh = minutes["resets"] > 0
    edges = np.linspace(firsts.min(), max(lasts.max(), firsts.min() + 1), _PARTS + 1)
    seen, _ = np.histogram(tracks["first_stamp_ns"], edges)
    edges = edges.astype(np.int64)
    return strips_over_time(
        [
            Strip("Recordings", "one bar each", firsts, lasts),
            Strip("RSOs", "tracks that begin", edges[:-1], edges[1:], seen.astype(float)),
            Strip(
                "Clouds",
                "% of a minute's frames without a motion of stars",
                *(starts, ends, blind),
                style="muted",
            ),
            Strip("New starts", "gaps, jumps", starts[fresh], ends[fresh], style="s1"),
            Strip(
                "Stars",
                "that move with the field, median of a minute",
                *(starts, ends, minutes["stars"]),
                line=True,
            ),
            Strip(
                "Noise",
                "DN in the smoothed image, median of a minute",
                *(starts, ends, minutes["noise"]),
                line=True,
                style="s1",
            ),
        ],
        "recordings, RSOs, clouds, stars and noise over the night",
    )


def _listed(tracks: _Rows, reports: dict[int, str]) -> list[dict[str, Any]]:
    return [
        {
            **{name: track[name] for name in tracks.dtype.names or ()},
            "style": _style(i),
            "link": _link(track, reports),
            "span_s": float(track["last_stamp_ns"] - track["first_stamp_ns"]) / 1e9,
            "place": words.sexagesimal(track["first_ra_deg"], track["first_dec_deg"]),
        }
        for i, track in enumerate(tracks)
    ]


def _recording(result: Result, minutes: _Rows, report: str) -> dict[str, Any]:
    frames = int(minutes["frames"].sum())
    return {
        **{"name": result.name, "link": report, "first_ns": result.first_stamp_ns},
        "span_s": (result.last_stamp_ns - result.first_stamp_ns) / 1e9,
        **{"frames": result.frames, "tracks": result.tracks, "notes": len(result.problems)},
        **{name: _median(minutes[name]) for name in ("stars", "noise")},
        "blind": 100 * int(minutes["blind"].sum()) / frames if frames else float("nan"),
    }


def _median(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _made(results: list[Result]) -> list[tuple[str, int]]:
    """With what the results were made, and how many so."""
    ways = Counter(
        f"ofsat_ros {one.version or '?'}, preset {one.preset or '?'}"
        + ", as the live node would say" * one.live
        for one in results
    )
    return ways.most_common()


def _night(catalog: Catalog, night: Night) -> dict[str, Any]:
    """One night in the archive."""
    results = catalog.results(night)
    tracks = catalog.query(_of(night))
    minutes = catalog.minutes(results)
    located = np.isfinite(tracks["first_ra_deg"])
    frames = int(minutes["frames"].sum())
    magnitudes = tracks["magnitude"][np.isfinite(tracks["magnitude"])]
    return {
        **{"name": f"{night}", "link": f"{NIGHTS}/{night}.html"},
        **{"first_ns": night.first_ns, "end_ns": night.end_ns},
        **{"recordings": len(results), "tracks": len(tracks)},
        "frames": sum(one.frames for one in results),
        "recorded_s": _recorded_s(results),
        "brightest": float(magnitudes.min()) if len(magnitudes) else float("nan"),
        **{name: _median(minutes[name]) for name in ("stars", "noise")},
        "blind": 100 * int(minutes["blind"].sum()) / frames if frames else float("nan"),
        "notes": len(_notes(results)),
        **{"ra": tracks["first_ra_deg"][located], "dec": tracks["first_dec_deg"][located]},
    }


def _archive_headline(
    nights: list[dict[str, Any]], results: list[Result], failed: Mapping[str, str]
) -> dict[str, Any]:
    found = sum(night["tracks"] for night in nights)
    said = [f"{words.count(len(results), 'recording')} have results."]
    if failed:
        said.append(f"{words.count(len(failed), 'recording')} could not be processed.")
    if found:
        best = max(nights, key=lambda night: night["tracks"])
        said.append(f"Most tracks, {best['tracks']}, are of the night of {best['name']}.")
    return {
        "headline": f"{words.count(found, 'track') if found else 'No track'} in"
        f" {words.count(len(nights), 'night')}",
        "lead": " ".join(said),
        "facts": [
            ("recordings", f"{len(results)}"),
            ("frames", words.number(sum(one.frames for one in results), 1)),
            ("recorded", words.duration(_recorded_s(results))),
            ("tracks with directions", f"{sum(len(night['ra']) for night in nights)}"),
        ],
    }


def _archive_line(nights: list[dict[str, Any]]) -> str:
    starts, ends = (
        np.array([night[name] for night in nights], np.int64) for name in ("first_ns", "end_ns")
    )

    def strip(
        name: str, meaning: str, field: str, factor: float = 1.0, style: str = "s0"
    ) -> Strip:
        values = factor * np.array([night[field] for night in nights], float)
        return Strip(name, meaning, starts, ends, values, style=style)

    return strips_over_time(
        [
            strip("RSOs", "tracks of a night", "tracks"),
            strip("Recorded", "hours", "recorded_s", 1 / 3600),
            strip("Clouds", "% of frames without a motion of stars", "blind", style="muted"),
            strip("Stars", "that move with the field, median", "stars"),
            strip("Noise", "DN in the smoothed image, median", "noise", style="s1"),
        ],
        "RSOs, hours, clouds, stars and noise, night by night",
    )
