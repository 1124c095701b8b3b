# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``report.html``: a folder of results as one page that needs nothing else.

The last step of ``ofsat process``, and all of ``ofsat report``.  Reads the folder (`findings`) and
then the recording once more (`looks`), and puts words, charts and pictures into ``page/``'s
template.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.recordings import RecordingError
from ofsat_ros.report import words
from ofsat_ros.report.again import open_again, processed
from ofsat_ros.report.charts import Series, chart, sparkline
from ofsat_ros.report.findings import Findings, Track, read_findings
from ofsat_ros.report.looks import CutOuts, Gallery, Sky, View
from ofsat_ros.report.template import page_template
from ofsat_ros.results import ResultError, write_whole

REPORT = "report.html"
# Tracks with cut-outs and charts, and rows of the table of tracks.
_GALLERIES, _ROWS = 40, 400
_COLOURS = 8
_QUALITY = 82
# Points that a drawn path has at most.
_PATH_POINTS = 240
# Of more recordings than these, the first and the last are named.
_PATHS = 3
# Streaks shorter than this, px, say nothing.
_LEAST_STREAK_PX = 5.0


def write_report(
    folder: str | Path,
    recording: str | Path | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Path:
    """Write ``report.html`` into a folder of results; an older one is replaced.

    Parameters
    ----------
    folder : str or Path
        What ``ofsat process`` has made.
    recording : str or Path, optional
        Where the recording is now, if not where it was.
    say : callable, optional
        Takes a line for the user.

    Returns
    -------
    Path
        The file.  Where the recording cannot be read, and none was given, it has no pictures, and
        says why.

    Raises
    ------
    RecordingError
        If the recording that was given cannot be read, or is another one.
    ModuleNotFoundError
        If jinja2 is missing; the message names the extra that brings it.
    ResultError
        If the folder holds no results.
    OSError
        If a file cannot be read, or written.
    """
    template = page_template("page.html")
    folder = Path(folder)
    findings = read_findings(folder)
    views: list[View] = []
    galleries: dict[int, Gallery] = {}
    no_pictures = ""
    try:
        views, galleries = _pictures(findings, recording)
    except (RecordingError, OSError) as error:
        if recording:
            raise
        no_pictures = f"no pictures: {error}"
        say(f"note: {REPORT} has {no_pictures}")
    page = template.render(
        **_about(findings),
        no_pictures=no_pictures,
        views=[_view(view, findings) for view in views],
        tracks=_tracks(findings, galleries),
        unlisted=max(len(findings.tracks) - _ROWS, 0),
        **_charts(findings),
    )
    path = folder / REPORT
    write_whole(path, page, "replace")  # a file's name need not be Unicode
    return path


def _pictures(
    findings: Findings, recording: str | Path | None
) -> tuple[list[View], dict[int, Gallery]]:
    """Look at the recording again."""
    sky, cut_outs = Sky(findings), CutOuts(findings.tracks[:_GALLERIES])
    with open_again(findings, recording) as frames:
        for number, image in processed(frames, findings, "pictures"):
            sky.add(findings.row_of[number], image)
            cut_outs.add(number, image)
    return sky.views(), cut_outs.galleries()


def _about(findings: Findings) -> dict[str, Any]:
    run, frames = findings.run, findings.frames
    named = words.recordings(run) or ["?"]
    used = words.parameters_used(run)
    profile = sorted((run.get("profile") or {}).items(), key=lambda row: -row[1])
    return {
        "headline": words.headline(findings),
        "lead": words.lead(findings),
        "run": run,
        "recording": ", ".join(Path(path).name for path in named)
        if len(named) <= _PATHS
        else f"{len(named)} files, from {Path(named[0]).name} to {Path(named[-1]).name}",
        "paths": named if len(named) <= _PATHS else [named[0], "…", named[-1]],
        "first_ns": int(frames["stamp_ns"][0]) if len(frames) else None,
        "span_s": float(findings.seconds[-1]) if len(frames) else 0.0,
        "step_s": findings.step_s if (frames["dt_s"] > 0).any() else float("nan"),
        "stars": float(np.median(frames["stars"][1:])) if len(frames) > 1 else float("nan"),
        "candidates": int((findings.detections["track_id"] == 0).sum()),
        "changed": [row for row in used if row[2]],
        "parameters": used,
        "command": words.command_line(run),
        "profile": [(name.replace("_", " "), seconds) for name, seconds in profile],
        "profile_s": sum(seconds for name, seconds in profile if "meanwhile" not in name),
    }


def _view(view: View, findings: Findings) -> dict[str, Any]:
    height, width = view.picture.shape
    drawn, elsewhere = [], 0
    for i, track in enumerate(findings.tracks[:_ROWS]):
        if not findings.is_in_main_stretch(track):
            elsewhere += 1
            continue
        path = view.paths(track)
        points = path[np.unique(np.linspace(0, len(path) - 1, _PATH_POINTS).round().astype(int))]
        x, y = path[-1]
        drawn.append(
            {
                "number": track.number,
                "style": _style(i),
                "path": "M" + "L".join(f"{a + 0.5:.1f} {b + 0.5:.1f}" for a, b in points),
                "left": 100 * (x + 0.5) / width,
                "top": 100 * (y + 0.5) / height,
                "labelled": i < _GALLERIES,
            }
        )
    return {
        "name": view.name,
        "meaning": view.meaning,
        "source": _source(view.picture, ".jpg"),
        "width": width,
        "height": height,
        "tracks": drawn,
        "elsewhere": elsewhere,
    }


def _tracks(findings: Findings, galleries: dict[int, Gallery]) -> list[dict[str, Any]]:
    listed = []
    for i, track in enumerate(findings.tracks[:_ROWS]):
        rows = track.rows
        first, last = rows[0], rows[-1]
        own = np.hypot(rows["vx_px_s"], rows["vy_px_s"])
        rel_vx, rel_vy = np.median(rows["rel_vx_px_s"]), np.median(rows["rel_vy_px_s"])
        listed.append(
            {
                "number": track.number,
                "style": _style(i),
                "rows": len(rows),
                "spanned": int(
                    findings.row_of[int(last["frame"])] - findings.row_of[int(first["frame"])] + 1
                ),
                "first_ns": int(first["stamp_ns"]),
                "last_ns": int(last["stamp_ns"]),
                "span_s": float(track.seconds[-1]),
                "snr": track.snr,
                "snr_low": float(rows["snr"].min()),
                "snr_high": float(rows["snr"].max()),
                "flux": track.flux,
                "speed": track.speed,
                "heading_deg": float(np.degrees(np.arctan2(rel_vy, rel_vx))),
                "sensor_speed": float(np.median(own)),
                "followed": track.is_followed,
                "arcsec_per_s": track.arcsec_per_s,
                "length": float(np.median(rows["length_px"])),
                "streak": bool(np.median(rows["length_px"]) >= _LEAST_STREAK_PX),
                "from": words.sexagesimal(first["ra_deg"], first["dec_deg"]),
                "to": words.sexagesimal(last["ra_deg"], last["dec_deg"]),
                "spark": sparkline(rows["flux"], _style(i)),
                "smooth": track.smooth,
                "sigma": float(np.median(track.sigma)),
                "gallery": _gallery(galleries.get(track.number)),
                "charts": _track_charts(track, findings, _style(i)) if i < _GALLERIES else [],
            }
        )
    return listed


def _gallery(gallery: Gallery | None) -> dict[str, Any] | None:
    if gallery is None:
        return None
    return {
        "mean": _source(gallery.mean, ".png"),
        "count": gallery.count,
        "cuts": [(number, _source(cut, ".png")) for number, cut in gallery.cuts],
    }


def _track_charts(track: Track, findings: Findings, style: str) -> list[tuple[str, str, str]]:
    """(title, legend, drawing) of each chart of a track."""
    rows, number = track.rows, f"RSO {track.number}"
    start_ns = findings.frames["stamp_ns"][0]
    t, unit = _times((rows["stamp_ns"] - start_ns) / 1e9, float(findings.seconds[-1]))
    with np.errstate(divide="ignore", invalid="ignore"):
        magnitude = -2.5 * np.log10(rows["flux"] / np.median(rows["flux"]))
        error = 2.5 / np.log(10) / rows["snr"]
    velocity = rows["rel_vx_px_s"], rows["rel_vy_px_s"]
    heading = np.degrees(np.unwrap(np.arctan2(velocity[1], velocity[0])))
    residuals = track.smooth.residuals
    made = [
        (
            "Light curve",
            "magnitudes about the median, brighter up; bars: noise",
            chart(
                t,
                [Series("", magnitude, style, True, error)],
                unit,
                upside_down=True,
                label=f"light curve of {number}",
            ),
        ),
        (
            "Speed",
            "px/s against the stars",
            chart(t, [Series("", np.hypot(*velocity), style)], unit, label=f"speed of {number}"),
        ),
        (
            "Heading",
            "degrees against the stars, from right (0) towards down (90)",
            chart(t, [Series("", heading, style)], unit, label=f"heading of {number}"),
        ),
        (
            "Residuals",
            f"px about a smooth motion against the {track.smooth.against}: x filled, y grey; band:"
            " stated 1 \u03c3",
            chart(
                t,
                [
                    Series("", residuals[:, 1], "muted", True),
                    Series("", residuals[:, 0], style, True),
                ],
                unit,
                band=track.sigma,
                label=f"residuals of {number}",
            )
            if np.isfinite(residuals).any()
            else "",
        ),
    ]
    if np.median(rows["length_px"]) >= _LEAST_STREAK_PX:
        made.append(
            (
                "Streak",
                "length in one exposure, px",
                chart(t, [Series("", rows["length_px"], style, True)], unit, label="streak"),
            )
        )
    return [row for row in made if row[2]]


def _charts(findings: Findings) -> dict[str, Any]:
    """Charts of the star field and of the images, each a list of (title, legend, drawing)."""
    frames = findings.frames
    if len(frames) < 2:
        return {"star_charts": [], "image_charts": []}
    t, unit = _times(findings.seconds, float(findings.seconds[-1]))
    found = np.bincount(
        [
            findings.row_of[int(f)]
            for f in findings.detections["frame"]
            if int(f) in findings.row_of
        ],
        minlength=len(frames),
    )

    def one(title: str, legend: str, *series: Series, from_zero: bool = True) -> tuple[str, ...]:
        return title, legend, chart(t, series, unit, from_zero=from_zero, label=title)

    stars = [
        one(
            "Motion",
            "px a frame: x blue, y orange",
            Series("x", frames["dx_px"], "s0"),
            Series("y", frames["dy_px"], "s1"),
        ),
        one(
            "Residual", "px, rms of the stars about the motion", Series("", frames["residual_px"])
        ),
        one("Stars", "that move with the field", Series("", _after_first(frames["stars"]))),
    ]
    if np.nanmax(np.abs(frames["rotation_deg"]), initial=0) > 0:
        rotation = Series("", frames["rotation_deg"])
        stars.append(one("Rotation", "degrees a frame, from x to y", rotation, from_zero=False))
    about = "of RSOs" + " and candidates" * bool(findings.run["live"])
    images = [
        one("Background", "DN", Series("", frames["background"]), from_zero=False),
        one(
            "Noise and threshold",
            "DN over the background, smoothed image: noise blue, threshold orange",
            Series("", frames["noise"], "s0"),
            Series("", frames["threshold"], "s1"),
        ),
        one("Objects", "over the threshold", Series("", frames["objects"])),
        one("Detections", about, Series("", found)),
    ]
    return {
        "star_charts": [row for row in stars if row[2]],
        "image_charts": [row for row in images if row[2]],
    }


def _after_first(values: NDArray[np.int_]) -> NDArray[np.float64]:
    """Counts that the first frame cannot have."""
    counts = values.astype(float)
    counts[0] = np.nan
    return counts


def _times(seconds: NDArray[np.float64], whole_s: float) -> tuple[NDArray[np.float64], str]:
    for unit, length_s in (("h", 3600.0), ("min", 60.0)):
        if whole_s > 3 * length_s:
            return seconds / length_s, unit
    return seconds, "s"


def _style(index: int) -> str:
    return f"c{index % _COLOURS}"


def _source(picture: NDArray[np.uint8], kind: str) -> str:
    """The picture as an address that holds it."""
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY] if kind == ".jpg" else []
    done, data = cv2.imencode(kind, picture, options)
    if not done:
        raise ResultError(f"OpenCV cannot write {kind} pictures")
    mime = {".jpg": "jpeg", ".png": "png"}[kind]
    return f"data:image/{mime};base64,{base64.b64encode(data.tobytes()).decode()}"
