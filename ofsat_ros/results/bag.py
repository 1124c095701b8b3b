# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A bag of results, that plays beside the recording they are of.

It holds what a detector would have published, made without ROS: the same messages
(``messages.py``), on the same topics, with the stamps of the images.
"""

from __future__ import annotations

from pathlib import Path
from typing import Self

from ofsat_ros.pipeline import FrameResult
from ofsat_ros.recordings import BagWriter, header_message, message_type
from ofsat_ros.results.messages import MESSAGE_TYPES, ResultMessages

# Its folder, beside the files of results.
BAG = "results"


class ResultBag:
    """Writes results as a rosbag2 folder (MCAP); a context manager.

    It is whole also when an exception or Ctrl-C ends the ``with``.

    Parameters
    ----------
    folder : str or Path
        Where the folder ``results`` is made.
    marker_scale : float
        Length of drawn vectors, in frames of motion.
    force : bool
        Replace a bag that is there.

    Raises
    ------
    RecordingError
        If something else is there, or it cannot be made.
    """

    def __init__(self, folder: str | Path, marker_scale: float, force: bool = False) -> None:
        kinds = {name: message_type(kind) for name, kind in MESSAGE_TYPES.items()}
        self._messages = ResultMessages(kinds, lambda data: data)
        self._scale = marker_scale
        # Last: Ctrl-C before the ``with`` is reached would leave it open.
        self._bag = BagWriter(Path(folder) / BAG, force=force)

    def add(self, stamp_ns: int, frame_id: str, result: FrameResult) -> None:
        """Write what is said of a frame, with the stamp (ns UTC) and frame_id of its image.

        Raises
        ------
        RecordingError
            If the bag cannot be written, or cannot hold the stamp.
        """
        messages, header = self._messages, header_message(stamp_ns, frame_id)
        for topic, message in (
            ("/rso_detections", messages.detections(header, result.detections)),
            ("/rso_tracks", messages.tracks(header, result.tracks)),
            ("/star_field_motion", messages.star_field_motion(header, result)),
            ("/flow_markers", messages.flow_markers(header, result, self._scale)),
        ):
            self._bag.write_message(topic, message, stamp_ns)

    def close(self) -> None:
        """Finish the bag; a second call does nothing."""
        self._bag.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
