# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Video files, as far as OpenCV reads them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from ofsat_ros.images import luminance
from ofsat_ros.recordings.bag import RecordingError, Topic
from ofsat_ros.recordings.recording import FRAME_ID, Attitude, Frame, Skipped, for_opencv
from ofsat_ros.recordings.timing import NO_START, NS, Hints

SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv", ".ts")

# FFmpeg's name, as of four characters, of what it decodes to: grey of 8 bits, and of 16.
_GREY, _GREY_16 = b"Y800", b"Y1\x00\x10"


class VideoSource:
    """A video as a `Source`, or several that follow each other, as a camera program splits one.

    Parameters
    ----------
    path : Path
        Where they are, for messages.
    files : list of Path
        In their order.
    hints : Hints
    """

    kind = "video"
    topic = camera_info_topic = attitude_topic = ""
    last_attitudes: tuple[Attitude, ...] = ()

    def __init__(self, path: Path, files: list[Path], hints: Hints) -> None:
        self.path, self._files, self._hints = path, files, hints
        self.topics: dict[str, int] = {}
        self.contents: dict[str, Topic] = {}
        self.problems = [] if hints.start_ns is not None else [NO_START]
        self._video: cv2.VideoCapture | None = None
        self._counts: list[int] = []
        rates = []
        try:
            for file in files:
                rates.append(self._look(file))
        finally:
            self.close()
        self.count = sum(self._counts)
        self._fps = hints.fps or rates[0]
        if hints.fps:
            return
        if not all(rates):
            missing = files[rates.index(0)]
            raise RecordingError(f"{missing} does not tell its rate: give it, as in --fps 20")
        if len(set(rates)) > 1:
            raise RecordingError(
                f"these videos play at different rates, {min(rates):g} to {max(rates):g} frames a"
                " second: give the camera's, as in --fps 20, or read them one by one"
            )
        self.problems.append(
            f"the rate, {self._fps:g} frames a second, is the one at which the video plays: if"
            " the camera's was another one, give it, as in --fps 20"
        )

    def close(self) -> None:
        """See `Source`."""
        if self._video is not None:
            self._video.release()
            self._video = None

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """See `Source`."""
        number, start_ns = 0, self._hints.first_ns or 0
        for file, count in zip(self._files, self._counts, strict=True):
            before = number
            for image in self._images(file, count):
                if number < first:
                    yield None
                elif image is None:
                    name = f"frame {number} ({file.name})"
                    yield Skipped(name, "the file ends within it, or after it")
                else:
                    stamp_ns = start_ns + round(number * NS / self._fps)
                    exposure_s = self._hints.exposure_s
                    yield Frame(image, stamp_ns, FRAME_ID, number, exposure_s=exposure_s)
                number += 1
            if number == before:
                raise RecordingError(f"{file}: no frame of it can be decoded")
            # What a torn file lacks has its time nevertheless.
            number = max(number, before + count)

    def _images(self, file: Path, count: int) -> Iterator[np.ndarray | None]:
        """Yield the images of a file; None at its end if it is torn."""
        self.close()
        self._video = self._opened(file)
        number, image = 0, self._next()
        while image is not None:
            following = self._next()
            # Decoders fill what is missing of a frame with grey, and do not tell.
            is_torn = following is None and number + 1 < count
            yield None if is_torn else image
            number, image = number + 1, following

    def _look(self, file: Path) -> float:
        """Take note of a file's count of frames, and return its rate; 0 if it tells none."""
        self.close()
        self._video = video = self._opened(file)
        count, told = video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)
        self._counts.append(int(count) if 0 < count < 1e7 else 0)
        self._see_depth(file)
        return told if math.isfinite(told) and 0 < told < 1e5 else 0.0

    def _opened(self, file: Path) -> cv2.VideoCapture:
        for_opencv(file)
        # What it would print of damaged files says nothing to a user.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        try:
            video = cv2.VideoCapture(f"{file}", cv2.CAP_FFMPEG)
        except cv2.error as error:
            raise RecordingError(f"{file} cannot be read as a video: {error}") from error
        if not video.isOpened():
            raise RecordingError(
                f"{file} is no video that OpenCV reads; an MP4 whose recording was broken off"
                " has no index and cannot be read either"
            )
        if _pixel_format(video) in (_GREY, _GREY_16):
            video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        return video

    def _next(self) -> np.ndarray | None:
        assert self._video is not None
        try:
            done, image = self._video.read()
        except cv2.error:
            return None
        return luminance(image) if done and image is not None else None

    def _see_depth(self, file: Path) -> None:
        """Say so if a video has more bits than OpenCV gives."""
        assert self._video is not None
        kind, image = _pixel_format(self._video), self._next()
        # Of a format with more than 8 bits, one end of the name is their number.
        bits = min(kind[0], kind[3])
        if image is not None and image.dtype == np.uint8 and 8 < bits <= 16:
            self.problems.append(
                f"{file} has {bits} bits, and OpenCV gives the highest 8 of them: it would"
                " give all 16 of grey FFV1 video, from version 4.7 on"
            )


def _pixel_format(video: cv2.VideoCapture) -> bytes:
    return int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).to_bytes(4, "little", signed=True)
