# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A film of a recording with what was found in it: a folder of results, looked at once more.

Unlike the live picture it knows how each track went on: a track has its id from its first frame.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CANDIDATE, CONFIRMED, DETECTION_DTYPE
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.report.again import open_again, processed
from ofsat_ros.report.findings import Findings, read_findings
from ofsat_ros.report.picture import annotate
from ofsat_ros.report.words import instant
from ofsat_ros.results import ResultError

_Picture = NDArray[np.uint8]

# px; the longest side of a film, and of a GIF, which is large for what it shows.
_LONGEST_SIDE, _GIF_SIDE = 1600, 640
_GIF_FRAMES, _GIF_COLOURS = 300, 64
# Frames per second: the recording's own, within what eyes follow.
_SLOWEST, _FASTEST = 8, 30
# Frames over which a track's tail reaches back.
_TAIL_FRAMES = 30


def write_video(folder: str | Path, path: str | Path, recording: str | Path | None = None) -> Path:
    """Write the frames of a run with what was found in them.

    Parameters
    ----------
    folder : str or Path
        What ``ofsat process`` has made.
    path : str or Path
        The film: ``.mp4`` (H.264, which plays nearly everywhere) or ``.gif``, in which long
        recordings have only every n-th frame.
    recording : str or Path, optional
        Where the recording is now, if not where it was.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModuleNotFoundError
        If a package is missing; the message names the extra that brings it.
    ResultError
        If the folder holds no results, or the name ends otherwise.
    RecordingError
        If the recording cannot be read, or is another one.
    OSError
        If a file cannot be read, or written.
    """
    path = Path(path)
    film = _FILMS.get(path.suffix.lower())
    if film is None:
        raise ResultError(f"{path}: a video is a file whose name ends in .mp4 or .gif")
    findings = read_findings(Path(folder))
    if not len(findings.frames):
        raise ResultError(f"{folder} holds no frame: there is nothing to show")
    rate = int(np.clip(round(1 / findings.step_s), _SLOWEST, _FASTEST))
    every = -(-len(findings.frames) // _GIF_FRAMES) if film is _gif else 1
    side = _GIF_SIDE if film is _gif else _LONGEST_SIDE
    tails = _tails(findings)
    unfinished = path.with_name(f".{path.name}.part")
    try:
        with film(unfinished, rate) as show, open_again(findings, recording) as frames:
            for number, image in processed(frames, findings, "video"):
                row = findings.row_of[number]
                if row % every == 0:
                    result, footer = _result(findings, row)
                    tail = {
                        number: places[max(0, last - _TAIL_FRAMES) : last + 1]
                        for number, (rows, places) in tails.items()
                        if (last := _last(rows, row)) is not None
                    }
                    picture = annotate(image, result, tails=tail, footer=footer)
                    show(_sized(picture, side))
        os.replace(unfinished, path)
    except OSError as error:
        if error.errno and error.filename in (None, f"{unfinished}"):  # as of a disk that is full
            # Anew: PyAV's errors cannot be given another name.
            raise OSError(error.errno, error.strerror, f"{path}") from error
        raise
    finally:
        with suppress(OSError):  # the folder may be gone
            unfinished.unlink()
    return path


def _tails(findings: Findings) -> dict[int, tuple[NDArray[np.int_], NDArray[np.float64]]]:
    """For each track the rows of its frames, and its places in them."""
    return {
        track.number: (
            np.array([findings.row_of[int(frame)] for frame in track.rows["frame"]]),
            track.places,
        )
        for track in findings.tracks
    }


def _last(rows: NDArray[np.int_], row: int) -> int | None:
    """Return which of a track's detections is that of a frame, if it is seen in it."""
    at = int(np.searchsorted(rows, row))
    return at if at < len(rows) and rows[at] == row else None


def _result(findings: Findings, row: int) -> tuple[FrameResult, str]:
    """What the tables tell of a frame, in the form in which the pipeline does, and a line."""
    frame, run = findings.frames[row], findings.run
    found = findings.detections[findings.detections["frame"] == frame["frame"]]
    detections = np.zeros(len(found), DETECTION_DTYPE)
    for name in ("x", "y", "sigma_x", "sigma_y", "length"):
        detections[name] = found[f"{name}_px"]
    for name in ("vx", "vy", "rel_vx", "rel_vy"):
        detections[name] = found[f"{name}_px_s"]
    for name in ("track_id", "snr", "flux"):
        detections[name] = found[name]
    detections["status"] = np.where(found["confirmed"] == 1, CONFIRMED, CANDIDATE)
    detections["object_index"] = detections["flow_index"] = -1
    result = FrameResult(
        stamp_ns=int(frame["stamp_ns"]),
        frame=int(frame["frame"]),
        shape=(run["height"], run["width"]),
        # Vectors are drawn by it, in frames that were compared with none, too.
        dt_s=findings.step_s,
        detections=detections,
        background=float(frame["background"]),
        noise=float(frame["noise"]),
        threshold=float(frame["threshold"]),
    )
    footer = f"{instant(result.stamp_ns)} UTC"
    if np.isfinite(frame["dx_px"]):
        footer += (
            f"; {frame['stars']} stars move ({frame['dx_px']:+.2f}, {frame['dy_px']:+.2f}) px"
        )
    return result, footer


def _sized(picture: _Picture, side: int) -> _Picture:
    """The picture not larger than wanted, and of even sides, which H.264 needs."""
    height, width = picture.shape[:2]
    zoom = min(1.0, side / max(height, width))
    size = (max(round(width * zoom) // 2, 1) * 2, max(round(height * zoom) // 2, 1) * 2)
    if size == (width, height):
        return picture
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


@contextmanager
def _mp4(path: Path, rate: int) -> Iterator[Callable[[_Picture], None]]:
    try:
        import av
    except ModuleNotFoundError as error:
        raise _missing("PyAV", error) from error
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as film:
        stream: Any = film.add_stream("libx264", rate, options={"crf": "23", "preset": "veryfast"})
        stream.pix_fmt = "yuv420p"

        def show(picture: _Picture) -> None:
            if not stream.codec_context.is_open:
                stream.height, stream.width = picture.shape[:2]
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))

        yield show
        film.mux(stream.encode())


@contextmanager
def _gif(path: Path, rate: int) -> Iterator[Callable[[_Picture], None]]:
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise _missing("Pillow", error) from error
    shown: list[Any] = []

    def show(picture: _Picture) -> None:
        whole = Image.fromarray(np.ascontiguousarray(picture[:, :, ::-1]))
        shown.append(whole.quantize(_GIF_COLOURS, dither=Image.Dither.NONE))

    yield show
    if shown:
        first, *others = shown
        first.save(path, "GIF", save_all=True, append_images=others, duration=1000 // rate, loop=0)


def _missing(what: str, error: ModuleNotFoundError) -> ModuleNotFoundError:
    return ModuleNotFoundError(
        f"this video needs {what}: pip install 'ofsat_ros[report]'", name=error.name
    )


_FILMS = {".mp4": _mp4, ".gif": _gif}
