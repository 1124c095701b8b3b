# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat info``: what a recording holds, and whether it can be processed."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import click

from ofsat_ros.cli.survey import survey
from ofsat_ros.cli.terminal import (
    fail,
    help_all,
    recording_argument,
    recording_options,
)
from ofsat_ros.printing import printable
from ofsat_ros.recordings import RecordingError, Topic, TopicError, open_recording
from ofsat_ros.report.words import process_words

_PATHS_SHOWN = 3


@click.command("info", epilog="Example: ofsat info night1")
@recording_argument
@recording_options
@click.option("--json", "as_json", is_flag=True, help="print JSON instead of words")
@help_all
def command(paths: tuple[Path, ...], as_json: bool, **options: Any) -> None:
    """Say what RECORDING holds, and whether it can be processed.

    RECORDING is what process reads: a bag, FITS, SER, a video, images; a file, or a folder of
    them; several are taken for one.  Every frame is read.  The exit code is 0 if it can be
    processed, and 1 if not.
    """
    told: dict[str, Any] = {"path": _json_of(paths), "kind": "", "topics": {}, "images": []}
    problem = ""
    try:
        try:
            _add(told, paths, options)
        except TopicError as error:
            told["topics"] = _topics(error.topics)
            images = [name for name, about in error.topics.items() if about.is_image]
            filled = [name for name in images if error.topics[name].count]
            if not filled:
                raise
            for name in filled:
                _add(told, paths, {**options, "topic": name})
                if told["images"][-1]["stopped"]:
                    break
    except (RecordingError, OSError) as error:
        if not (told["topics"] or as_json):
            fail(error)
        problem = f"{error}"
    told["problem"] = problem
    told["processable"] = any(not about["hindrance"] for about in told["images"])
    click.echo(
        json.dumps(told, indent=2) if as_json else "\n".join(map(printable, _words(told, paths)))
    )
    if any(about["stopped"] for about in told["images"]):
        sys.exit(130)
    sys.exit(0 if told["processable"] else 1)


def _add(told: dict[str, Any], paths: tuple[Path, ...], options: dict[str, Any]) -> None:
    """Add what the images of one topic, or of files, tell."""
    with open_recording(paths, **options) as recording:
        told["kind"] = recording.kind
        told["topics"] = told["topics"] or _topics(recording.contents)
        about = survey(recording)
    given = recording.topic if len(recording.topics) > 1 else None
    about["command"] = shlex.join(process_words(paths, {**options, "topic": given}))
    told["images"].append(about)


def _topics(contents: dict[str, Topic]) -> dict[str, Any]:
    return {
        name: {"type": about.msgtype, "messages": about.count} for name, about in contents.items()
    }


def _json_of(paths: tuple[Path, ...]) -> str | list[str]:
    return f"{paths[0]}" if len(paths) == 1 else [f"{path}" for path in paths]


def _words(told: dict[str, Any], paths: tuple[Path, ...]) -> Iterator[str]:
    """Yield the lines for people."""
    more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
    yield f"{paths[0]}{more}: {told['kind'] or 'nothing that can be read'}"
    topics = told["topics"]
    for name, about in topics.items():
        yield f"  {name:<{max(map(len, topics))}}  {about['messages']:>7}  {about['type']}"
    for about in told["images"]:
        yield ""
        if about["topic"]:
            yield about["topic"]
        for name, words in _lines(about):
            yield f"  {name:<12}{words}"
    yield ""
    if told["problem"]:
        yield f"It cannot be processed: {told['problem']}"
    for about in told["images"]:
        what = about["topic"] if len(told["images"]) > 1 else "It"
        if about["hindrance"]:
            yield f"{what} cannot be processed: {about['hindrance']}"
        elif len(paths) <= _PATHS_SHOWN:
            yield f"{what} can be processed: {about['command']}"
        else:
            yield f"{what} can be processed: ofsat process, with the same names and options"


def _lines(about: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the lines about the images of one topic, or of files: a name, and what it is."""
    more = f", {about['skipped']} more could not be read" if about["skipped"] else ""
    yield "frames", f"{about['frames']}{more}{', then stopped' if about['stopped'] else ''}"
    if about["frames"]:
        yield from _pixels(about)
        yield from _timing(about)
        yield "directions", _directions(about)
    for problem in about["problems"]:
        yield "note", problem


def _pixels(about: dict[str, Any]) -> Iterator[tuple[str, str]]:
    sizes = [f"{width}x{height} px" for width, height, _ in about["sizes"]]
    if len(sizes) > 1:
        counts = (count for *_, count in about["sizes"])
        sizes = [f"{size} ({count})" for size, count in zip(sizes, counts, strict=True)]
    yield "size", ", ".join(sizes)
    words = f"{about['encoding']}: " if about["encoding"] else ""
    words += f"{', '.join(about['pixels'])}"
    if about["highest"] is not None:
        words += f", values {about['lowest']:.10g} to {about['highest']:.10g}"
        if about["pixels"][0].startswith("uint"):
            words += f" ({about['highest'].bit_length()} bits)"
    yield "pixels", words


def _timing(about: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "from", f"{about['first_utc']}"
    span_s = (about["last_stamp_ns"] - about["first_stamp_ns"]) / 1e9
    span = timedelta(seconds=round(span_s)) if span_s >= 60 else f"{span_s:.6g} s"
    yield "to", f"{about['last_utc']}, {span} later"
    usual_s, gaps = about["interval_s"], about["gaps"]
    if usual_s:
        rate = f"one every {usual_s:.4g} s" if usual_s >= 1 else f"{1 / usual_s:.4g} per second"
        yield "rate", rate
        if gaps["count"]:
            worst = gaps["longest"][0]
            words = f"{gaps['count']}, of some {gaps['missing_frames']} frames; the longest"
            yield "gaps", f"{words} {worst['seconds']:.4g} s after frame {worst['after_frame']}"
        else:
            yield "gaps", "none"
    if about["frames_back_in_time"]:
        count, first = about["frames_back_in_time"], about["first_back_in_time"]
        yield "disorder", f"{count} frames are no later than the one before, frame {first} first"
    if exposures := about["exposures_s"]:
        ends = sorted({f"{exposures[0]:.6g}", f"{exposures[-1]:.6g}"}, key=float)
        yield "exposure", f"{' to '.join(ends)} s"


def _directions(about: dict[str, Any]) -> str:
    camera, boresight = about["camera"], about["first_boresight_deg"]
    words = ["no calibration", "no attitude"]
    if camera:
        field = [camera[side] * camera["arcsec_per_px"] / 3600 for side in ("width", "height")]
        words[0] = (
            f"{camera['arcsec_per_px']:.4g} arcsec per px, a field of {field[0]:.3g} x"
            f" {field[1]:.3g} deg"
        )
        if [camera["width"], camera["height"]] not in [size[:2] for size in about["sizes"]]:
            words[0] = f"a calibration for {camera['width']}x{camera['height']} px, so of no use"
    if boresight:
        count = about["frames_with_attitude"]
        words[1] = f"ra {boresight[0]:.4f} dec {boresight[1]:+.4f} deg at first"
        words[1] += f", {count} attitudes" if count != about["frames"] else ""
    return "; ".join(words)
