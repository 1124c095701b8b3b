# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Make what README and docs show: pictures and the table of parameters.

``python docs/generate.py`` rewrites the files; ``test/test_readme.py`` says when that is due.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2

from ofsat_ros.parameters import markdown_table
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.report import Tails, annotate
from ofsat_ros.simulation import scenario

DOCS = Path(__file__).parent
README = DOCS.parent / "README.md"
# picture, scenario, frame, seed
PICTURES = (("geo.png", "geo", 12, 4), ("sidereal.png", "sidereal", 40, 1))


def picture(name: str, number: int, seed: int) -> cv2.typing.MatLike:
    """Return the annotated picture of one frame of a scenario."""
    sky, pipeline, tails = scenario(name, seed), Pipeline(), Tails()
    for frame in sky:
        result = pipeline.process(frame.image, frame.stamp_ns)
        tails.add(result)
        if frame.frame == number:
            return annotate(frame.image, result, scale=1.0, tails=tails.places())
    raise ValueError(f"{name} has no frame {number}")


def with_table(readme: str) -> str:
    """Return the README with the present table of parameters between its marks."""
    marked = re.compile(r"(<!-- parameters -->\n).*?(<!-- end of parameters -->)", re.S)
    return marked.sub(lambda m: m[1] + markdown_table() + m[2], readme)


def main() -> None:
    """Write everything."""
    for file, name, number, seed in PICTURES:
        cv2.imwrite(str(DOCS / "images" / file), picture(name, number, seed))
    README.write_text(with_table(README.read_text()))


if __name__ == "__main__":
    main()
