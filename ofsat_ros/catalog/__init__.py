# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A catalogue of tracks: the results of many recordings in one SQLite file.

Stands after ``results``: `Catalog` takes in folders of results, keeps where each came from, and
answers questions about their tracks by time, place on the sky, rate and brightness (`Selection`).
The file is for others too: its tables and columns, with units, stand in schema.py and in itself
(``sqlite3 catalog.sqlite .schema``).
"""

from ofsat_ros.catalog.catalog import CATALOG, Catalog, Result
from ofsat_ros.catalog.night import Night
from ofsat_ros.catalog.schema import MINUTE_DTYPE, PATH_DTYPE, TRACK_DTYPE
from ofsat_ros.catalog.selection import Cone, Selection
from ofsat_ros.catalog.storage import CatalogError

__all__ = [
    "CATALOG",
    "MINUTE_DTYPE",
    "PATH_DTYPE",
    "TRACK_DTYPE",
    "Catalog",
    "CatalogError",
    "Cone",
    "Night",
    "Result",
    "Selection",
]
