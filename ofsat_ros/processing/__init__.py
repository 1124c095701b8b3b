# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A recording, from its first frame to its result files: what ``ofsat process`` does.

Stands between ``recordings`` and ``results`` and runs the same `Pipeline` as the detector node;
what the command's options mean is ``cli``'s.  A `Job` (job.py) says what to process, and how;
`Processing` (run.py) takes the frames through the pipeline, and `Output` (output.py) what they
give into files.  A long recording may be cut into segments (segments.py), each a job, whose
results `join` (joining.py) makes one, as of one run.
"""

from ofsat_ros.processing.job import SOURCE, Job, Run
from ofsat_ros.processing.joining import join
from ofsat_ros.processing.run import Processing, Watch
from ofsat_ros.processing.segments import Segment, cut
from ofsat_ros.processing.totals import Totals

__all__ = ["SOURCE", "Job", "Processing", "Run", "Segment", "Totals", "Watch", "cut", "join"]
