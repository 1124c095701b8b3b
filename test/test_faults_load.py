# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A viewer that hangs gets no more pictures until it takes them, and nobody waits for it."""

import logging
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from std_msgs.msg import Header

from ofsat_ros.nodes.drawing import Drawing
from ofsat_ros.pipeline import FrameResult

pytestmark = pytest.mark.alone

_PATIENCE_S = 20.0


class Pictures:
    """A publisher of pictures whose viewer takes them, or not."""

    topic_name = "/image_annotated"

    def __init__(self) -> None:
        self.taken, self.sent, self.asked = True, 0, 0

    def get_subscription_count(self) -> int:
        return 1

    def wait_for_all_acked(self, timeout) -> bool:
        assert timeout.nanoseconds == 0  # rclpy lets no other thread run meanwhile
        self.asked += 1
        return self.taken

    def publish(self, _: object) -> None:
        self.sent += 1


class Nobody:
    """A publisher that nobody hears."""

    def get_subscription_count(self) -> int:
        return 0


class Stage:
    """A drawing, who looks at it, and what it logs and tells."""

    def __init__(self, every_frame: bool) -> None:
        self.pictures, self.warnings, self.drawn_frames = Pictures(), [], 0
        self.drawing = Drawing(self, Nobody(), self.pictures, every_frame, self)

    def get_logger(self) -> "Stage":
        return self

    def warning(self, words: str, **_: object) -> None:
        self.warnings.append(words)

    def error(self, words: str, **_: object) -> None:
        logging.getLogger().error(words)
        pytest.fail(words)

    def drawn(self, _: float) -> None:
        self.drawn_frames += 1

    def pace(self) -> str:
        return ""

    def show(self) -> None:
        """Show a frame, and wait until it is dealt with."""
        before = self.drawn_frames
        image = np.zeros((32, 32), np.uint16)
        self.drawing.show(Header(), image, FrameResult(0, 0, image.shape), 1.0)
        until(lambda: self.drawn_frames > before)


def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + _PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.002)


@pytest.fixture(params=[False, True], ids=["live", "every frame"])
def stage(request: pytest.FixtureRequest) -> Iterator[Stage]:
    stage = Stage(request.param)
    yield stage
    stage.drawing.close()


def test_a_viewer_that_takes_its_pictures_gets_all(stage: Stage):
    for count in range(1, 4):
        stage.show()
        assert stage.pictures.sent == count
    assert not stage.warnings


def test_a_viewer_that_hangs_gets_no_more_until_it_takes_them(stage: Stage):
    stage.show()
    stage.pictures.taken = False
    until(lambda: (stage.show(), bool(stage.warnings))[1])
    assert stage.pictures.sent == 1
    assert stage.warnings[0] == (
        "pictures are left out: a viewer of /image_annotated does not take them; end it, or let it"
        " ask for best effort"
    )
    # From now on nobody waits: each frame asks once.
    asked = stage.pictures.asked
    for _ in range(5):
        stage.show()
    assert (stage.pictures.asked, stage.pictures.sent) == (asked + 5, 1)
    stage.pictures.taken = True
    stage.show()
    assert stage.pictures.sent == 2
