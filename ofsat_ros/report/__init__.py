"""For people: frames with what was found drawn on them, and a report on a whole recording.

`annotate` and `summary` are of one frame, live (picture.py).  `write_report` makes a page
(html.py) and `write_video` a film (video.py) of a folder of results; both look at the recording a
second time and can be called whenever there is one.
"""

from ofsat_ros.report.html import REPORT, write_report
from ofsat_ros.report.picture import Tails, annotate, summary
from ofsat_ros.report.video import write_video

__all__ = ["REPORT", "Tails", "annotate", "summary", "write_report", "write_video"]
