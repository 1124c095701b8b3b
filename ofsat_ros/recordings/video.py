"""Video files, as far as OpenCV reads them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from ofsat_ros.images import luminance
from ofsat_ros.recordings.bag import RecordingError
from ofsat_ros.recordings.recording import FRAME_ID, Attitude, Frame, Skipped
from ofsat_ros.recordings.timing import NO_START, NS

SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv", ".ts")

# FFmpeg's name, as of four characters, of what it decodes to: grey of 8 bits, and of 16.
_GREY, _GREY_16 = b"Y800", b"Y1\x00\x10"


class VideoSource:
    """A video as a `Source`; `fps` and `exposure_s` as in `open_recording`."""

    kind = "video"
    topic = camera_info_topic = attitude_topic = ""
    last_attitudes: tuple[Attitude, ...] = ()

    def __init__(self, path: Path, fps: float | None, exposure_s: float | None) -> None:
        self.path, self._exposure_s = path, exposure_s
        self.topics: dict[str, int] = {}
        self._video = self._opened()
        told = self._video.get(cv2.CAP_PROP_FPS)
        count = self._video.get(cv2.CAP_PROP_FRAME_COUNT)
        self.count = int(count) if 0 < count < 1e7 else 0
        self._fps = fps or (told if math.isfinite(told) and 0 < told < 1e5 else 0.0)
        if not self._fps:
            self.close()
            raise RecordingError(f"{path} does not tell its rate: give it, as in --fps 20")
        self.problems = [NO_START]
        self._see_depth()
        if not fps:
            self.problems.append(
                f"the rate, {self._fps:g} frames a second, is the one at which the video plays: if"
                " the camera's was another one, give it, as in --fps 20"
            )

    def close(self) -> None:
        """See `Source`."""
        self._video.release()

    def frames(self, say: Callable[[str], None]) -> Iterator[Frame | Skipped]:
        """See `Source`."""
        self._video.release()
        self._video = self._opened()
        number, image = 0, self._next()
        while image is not None:
            following = self._next()
            if following is None and number + 1 < self.count:
                # Decoders fill what is missing of a frame with grey, and do not tell.
                yield Skipped(f"frame {number}", "the file ends within it, or after it")
                return
            stamp_ns = round(number * NS / self._fps)
            yield Frame(image, stamp_ns, FRAME_ID, number, exposure_s=self._exposure_s)
            number, image = number + 1, following
        if not number:
            raise RecordingError(f"{self.path}: no frame of it can be decoded")

    def _opened(self) -> cv2.VideoCapture:
        # What it would print of damaged files says nothing to a user.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        try:
            video = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        except cv2.error as error:
            raise RecordingError(f"{self.path} cannot be read as a video: {error}") from error
        if not video.isOpened():
            raise RecordingError(
                f"{self.path} is no video that OpenCV reads; an MP4 whose recording was broken off"
                " has no index and cannot be read either"
            )
        if _pixel_format(video) in (_GREY, _GREY_16):
            video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        return video

    def _next(self) -> np.ndarray | None:
        try:
            done, image = self._video.read()
        except cv2.error:
            return None
        return luminance(image) if done and image is not None else None

    def _see_depth(self) -> None:
        """Say so if the video has more bits than OpenCV gives."""
        kind, image = _pixel_format(self._video), self._next()
        # Of a format with more than 8 bits, one end of the name is their number.
        bits = min(kind[0], kind[3])
        if image is not None and image.dtype == np.uint8 and 8 < bits <= 16:
            self.problems.append(
                f"{self.path} has {bits} bits, and OpenCV gives the highest 8 of them: it would"
                " give all 16 of grey FFV1 video, from version 4.7 on"
            )


def _pixel_format(video: cv2.VideoCapture) -> bytes:
    return int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).to_bytes(4, "little", signed=True)
