# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The one table of parameters: name, default, range, unit, meaning.

Everything else that shows a parameter derives from it: ROS descriptors (``nodes``), the presets'
YAML files, command-line options (``cli``), and the table in the README.  It stands before all
stages and depends on none.

A parameter is a field of a frozen dataclass (`table`).  ``Parameters`` (in `stages`) holds what
the pipeline reads; the others (in `nodes`) what a node reads, or a part beside the pipeline.
"""

from __future__ import annotations

from ofsat_ros.parameters.nodes import (
    CameraParameters,
    DetectorParameters,
    GuideParameters,
    PlayerParameters,
    RecorderParameters,
    SimulatorParameters,
    TdmWriterParameters,
    TrackingDataParameters,
)
from ofsat_ros.parameters.stages import DEFAULT_PRESET, Parameters, preset_names
from ofsat_ros.parameters.table import Description, ParameterError, Table

__all__ = [
    "DEFAULT_PRESET",
    "TABLES",
    "CameraParameters",
    "Description",
    "DetectorParameters",
    "GuideParameters",
    "ParameterError",
    "Parameters",
    "PlayerParameters",
    "RecorderParameters",
    "SimulatorParameters",
    "Table",
    "TdmWriterParameters",
    "TrackingDataParameters",
    "markdown_table",
    "preset_names",
]

TABLES: tuple[type[Table], ...] = (
    Parameters,
    CameraParameters,
    DetectorParameters,
    PlayerParameters,
    SimulatorParameters,
    RecorderParameters,
    GuideParameters,
    TrackingDataParameters,
    TdmWriterParameters,
)


def markdown_table() -> str:
    """Return the table of all parameters as Markdown, as the README shows it."""
    rows = [
        "| parameter | default | range | unit | read by | meaning |",
        "|---|---|---|---|---|---|",
    ]
    for table in TABLES:
        for p in table.describe():
            default = str(p.default).lower() if isinstance(p.default, bool) else f"{p.default}"
            cells = [f"`{p.name}`", default, p.allowed.replace("|", "\\|"), p.unit, p.stage]
            meaning = p.meaning + ("" if p.live else " (set at start)")
            rows.append("| " + " | ".join([*cells, meaning]) + " |")
    return "\n".join(rows) + "\n"
