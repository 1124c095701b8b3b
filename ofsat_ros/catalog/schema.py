# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The tables of a catalogue, and what of them is read at once, as arrays."""

from __future__ import annotations

import numpy as np

# Marks the file as a catalogue of ours ("ofsa"), and says which tables it has.
APPLICATION_ID = 0x6F667361
VERSION = 1

# SQLite keeps the comments, and shows them with the tables.
SCHEMA = """
CREATE TABLE site (
  longitude_deg REAL NOT NULL      -- east positive; nights are told by it
);
CREATE TABLE results (             -- one folder that ofsat process or ofsat batch has made
  id INTEGER PRIMARY KEY,
  key TEXT,                        -- hash of all that the results depend on; NULL: not told
  content TEXT,                    -- sha256 of the recording's files; NULL: not told
  folder TEXT NOT NULL UNIQUE,     -- relative to this file's folder where it is inside it
  recording TEXT NOT NULL,         -- JSON: paths of what was processed; the newest result is kept
  name TEXT NOT NULL,              -- the last part of the first of them
  topic TEXT,
  version TEXT,                    -- of ofsat_ros
  preset TEXT,
  parameters TEXT NOT NULL,        -- JSON: each one's value
  live INTEGER NOT NULL,           -- 1: what the node says at each frame, 0: the last word on it
  stopped INTEGER NOT NULL,        -- 1: the run ended before the recording did
  started_utc TEXT,                -- when it was processed
  seconds REAL,                    -- that this took
  frames INTEGER NOT NULL,
  left_out INTEGER NOT NULL,       -- frames that could not be processed
  first_stamp_ns INTEGER NOT NULL, -- middle of the exposure, ns since 1970 UTC; as all stamps
  last_stamp_ns INTEGER NOT NULL,
  width_px INTEGER,
  height_px INTEGER,
  problems TEXT NOT NULL,          -- JSON: the notes that the user was given
  unlocated TEXT NOT NULL          -- JSON: counts of detections without direction, by the reason
);
CREATE INDEX results_by_time ON results (first_stamp_ns);
CREATE TABLE tracks (
  result INTEGER NOT NULL REFERENCES results ON DELETE CASCADE,
  track_id INTEGER NOT NULL,       -- its number in the result's own files
  first_stamp_ns INTEGER NOT NULL,
  last_stamp_ns INTEGER NOT NULL,
  first_frame INTEGER NOT NULL,
  last_frame INTEGER NOT NULL,
  detections INTEGER NOT NULL,
  first_x_px REAL, first_y_px REAL, last_x_px REAL, last_y_px REAL,
  vx_px_s REAL, vy_px_s REAL,      -- on the sensor, mean
  rel_vx_px_s REAL, rel_vy_px_s REAL, -- against the stars, mean
  rate_px_s REAL,                  -- against the stars
  rate_arcsec_s REAL,              -- NULL, as all below: no directions are known
  snr REAL,                        -- median
  flux REAL,                       -- DN, median
  length_px REAL,                  -- of the streak in an exposure, median
  first_ra_deg REAL, first_dec_deg REAL, -- ICRS
  last_ra_deg REAL, last_dec_deg REAL,
  -- A cap of the sphere that holds its whole path: unit vector of the middle, cos and sin of the
  -- radius.
  cap_x REAL, cap_y REAL, cap_z REAL, cap_cos REAL, cap_sin REAL,
  PRIMARY KEY (result, track_id)
) WITHOUT ROWID;
CREATE TABLE path (                -- of a track on the sky: great circles from place to place
  result INTEGER NOT NULL,
  track_id INTEGER NOT NULL,
  stamp_ns INTEGER NOT NULL,
  ra_deg REAL NOT NULL,
  dec_deg REAL NOT NULL,
  PRIMARY KEY (result, track_id, stamp_ns),
  FOREIGN KEY (result, track_id) REFERENCES tracks ON DELETE CASCADE
) WITHOUT ROWID;
CREATE TABLE minutes (             -- what the sky was like
  result INTEGER NOT NULL REFERENCES results ON DELETE CASCADE,
  start_ns INTEGER NOT NULL,       -- of the minute
  frames INTEGER NOT NULL,
  blind INTEGER NOT NULL,          -- frames in which no motion of the stars was found
  resets INTEGER NOT NULL,         -- frames that started afresh: a gap, a jump
  stars REAL,                      -- that move with the field, median
  noise REAL,                      -- DN, of the smoothed image, median
  background REAL,                 -- DN, median
  PRIMARY KEY (result, start_ns)
) WITHOUT ROWID;
"""

# Columns of `tracks` as they stand there, in the order in which rows are put in.
TRACK_NUMBERS = (
    *("track_id", "first_stamp_ns", "last_stamp_ns", "first_frame", "last_frame", "detections"),
    *("first_x_px", "first_y_px", "last_x_px", "last_y_px"),
    *("vx_px_s", "vy_px_s", "rel_vx_px_s", "rel_vy_px_s", "rate_px_s", "rate_arcsec_s"),
    *("snr", "flux", "length_px", "first_ra_deg", "first_dec_deg", "last_ra_deg", "last_dec_deg"),
)
CAP = ("cap_x", "cap_y", "cap_z", "cap_cos", "cap_sin")
_WHOLE = TRACK_NUMBERS[:6]

# What a question about tracks is answered with.
TRACK_DTYPE = np.dtype(
    [("result", "i8")]
    + [(name, "i8" if name in _WHOLE else "f8") for name in TRACK_NUMBERS]
    + [("magnitude", "f8"), ("recording", "O"), ("folder", "O")]
)
PATH_DTYPE = np.dtype(
    [("result", "i8"), ("track_id", "i8"), ("stamp_ns", "i8"), ("ra_deg", "f8"), ("dec_deg", "f8")]
)
MINUTE_DTYPE = np.dtype(
    [("result", "i8"), ("start_ns", "i8"), ("frames", "i8"), ("blind", "i8"), ("resets", "i8")]
    + [("stars", "f8"), ("noise", "f8"), ("background", "f8")]
)
