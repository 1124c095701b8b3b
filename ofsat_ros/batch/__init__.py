# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Many recordings on many cores or machines: what ``ofsat batch`` does.

Stands above ``processing``, whose `Job` it gives to Dask's workers (cluster.py, tasks.py), one for
each recording that is found (finding.py), or for each segment of a long one.  `Batch` (work.py)
knows what is to be done and what became of it; `Place` is the folder that all goes into, and
content.py says what a result is known by, so that it is made once.  Dask is imported when a
`Cluster` is made, not before.
"""

from ofsat_ros.batch.cluster import Cluster, ClusterError
from ofsat_ros.batch.content import content_key
from ofsat_ros.batch.finding import BATCH, Found, find_recordings
from ofsat_ros.batch.place import Place
from ofsat_ros.batch.tasks import RESULTS, Order
from ofsat_ros.batch.work import Batch, Outcome, Settings

__all__ = [
    "BATCH",
    "RESULTS",
    "Batch",
    "Cluster",
    "ClusterError",
    "Found",
    "Order",
    "Outcome",
    "Place",
    "Settings",
    "content_key",
    "find_recordings",
]
