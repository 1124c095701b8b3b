# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""CCSDS Tracking Data Messages of right ascension and declination (503.0-B-2, June 2020).

`tdm_kvn` and `tdm_xml` write the same message, as "keyword = value" text (section 4) and as XML
with unqualified elements (section 5).  One segment per arc.  What the standard has no keyword for,
the uncertainties above all, stands in comments of fixed wording.

The angles are ICRS and uncorrected, so that the message has no CORRECTION keywords.  The exposure
is not an INTEGRATION_INTERVAL: that is of Doppler counts and normal points (table 3-3), and the
standard's summary of angle data (annex I) has none.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from ofsat_ros import __version__
from ofsat_ros.parameters import TrackingDataParameters
from ofsat_ros.tracking_data.arcs import Arc

_VERSION = "2.0"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_SCHEMA = "https://sanaregistry.org/r/ndmxml_unqualified/ndmxml-2.0.0-master-2.0.xsd"
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_ARCSEC = math.radians(1 / 3600)
# 1e-8 deg is 0.04 milliarcseconds.
_ANGLE_DIGITS, _MAG_DIGITS, _SIGMA_DIGITS = 8, 3, 4

_Pairs = list[tuple[str, str]]


@dataclass(frozen=True)
class _Segment:
    comments: list[str]
    metadata: _Pairs
    data_comments: list[str]
    observations: list[tuple[str, str, str]]  # keyword, epoch, value


def tdm_kvn(arcs: Sequence[Arc], parameters: TrackingDataParameters, created_ns: int) -> str:
    """Return a message as text.

    Parameters
    ----------
    arcs : sequence of Arc
        At least one.
    parameters : TrackingDataParameters
    created_ns : int
        When the message is made, ns UTC.
    """
    comments, header = _header(parameters, created_ns)
    lines = [_pair("CCSDS_TDM_VERS", _VERSION), *map(_comment, comments)]
    lines += [_pair(*item) for item in header]
    for arc in arcs:
        segment = _segment(arc, parameters)
        lines += ["", "META_START", *map(_comment, segment.comments)]
        lines += [_pair(*item) for item in segment.metadata]
        lines += ["META_STOP", "", "DATA_START", *map(_comment, segment.data_comments)]
        lines += [f"{key} = {epoch} {value}" for key, epoch, value in segment.observations]
        lines.append("DATA_STOP")
    return "\n".join(lines) + "\n"


def tdm_xml(arcs: Sequence[Arc], parameters: TrackingDataParameters, created_ns: int) -> str:
    """Return a message as XML; see `tdm_kvn`."""
    root = ET.Element("tdm")
    root.set(f"{{{_XSI}}}noNamespaceSchemaLocation", _SCHEMA)
    root.set("id", "CCSDS_TDM_VERS")
    root.set("version", _VERSION)
    comments, header = _header(parameters, created_ns)
    _fill(ET.SubElement(root, "header"), comments, header)
    body = ET.SubElement(root, "body")
    for arc in arcs:
        segment = _segment(arc, parameters)
        element = ET.SubElement(body, "segment")
        _fill(ET.SubElement(element, "metadata"), segment.comments, segment.metadata)
        data = ET.SubElement(element, "data")
        _fill(data, segment.data_comments, [])
        for key, epoch, value in segment.observations:
            _fill(ET.SubElement(data, "observation"), [], [("EPOCH", epoch), (key, value)])
    ET.indent(root, " ")
    # The standard's own first line; ElementTree would quote it otherwise.
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, "unicode") + "\n"


def utc(stamp_ns: int) -> datetime:
    """Return a time, rounded to microseconds."""
    return _EPOCH + timedelta(microseconds=(stamp_ns + 500) // 1000)


def magnitudes(rows: NDArray[np.void], zero_point_mag: float) -> NDArray[np.float64]:
    """Return the magnitudes of an arc's rows (N,); NaN where unknown, and all without zero point.

    Parameters
    ----------
    rows : (N,) ARC_DTYPE
    zero_point_mag : float
        Magnitude of one DN per exposure; 0: unknown.
    """
    if not zero_point_mag:
        return np.full(len(rows), np.nan)
    flux = np.where(rows["flux"] > 0, rows["flux"], np.nan)
    return zero_point_mag - 2.5 * np.log10(flux)


def _header(parameters: TrackingDataParameters, created_ns: int) -> tuple[list[str], _Pairs]:
    return [f"Written by ofsat_ros {__version__}"], [
        ("CREATION_DATE", utc(created_ns).strftime("%Y-%m-%dT%H:%M:%S.%f")),
        ("ORIGINATOR", _words(parameters.originator)),
    ]


def _segment(arc: Arc, parameters: TrackingDataParameters) -> _Segment:
    rows = arc.rows
    epochs = _times(rows["stamp_ns"])
    magnitude = magnitudes(rows, parameters.zero_point_mag)
    observations = list(_observations(rows, epochs, magnitude))
    types = dict.fromkeys(key for key, _, _ in observations)
    metadata = [
        ("TRACK_ID", f"{utc(arc.first_ns):%Y%m%d_%H%M%S%f}-{arc.label}"),
        ("DATA_TYPES", ",".join(types)),
        ("TIME_SYSTEM", "UTC"),
        ("START_TIME", epochs[0]),
        ("STOP_TIME", epochs[-1]),
        ("PARTICIPANT_1", _words(parameters.station)),
        (
            "PARTICIPANT_2",
            _words(parameters.object_by_track.get(arc.label, f"UNKNOWN-{arc.label}")),
        ),
        ("MODE", "SEQUENTIAL"),
        ("PATH", "2,1"),
        ("TIMETAG_REF", "RECEIVE"),
        ("ANGLE_TYPE", "RADEC"),
        ("REFERENCE_FRAME", "ICRF"),
        ("DATA_QUALITY", "RAW"),
    ]
    return _Segment(_comments(rows, parameters), metadata, _sigmas(rows, epochs), observations)


def _observations(
    rows: NDArray[np.void], epochs: list[str], magnitude: NDArray[np.float64]
) -> Iterator[tuple[str, str, str]]:
    ras, decs = np.degrees(rows["ra"]) % 360, np.degrees(rows["dec"])
    for epoch, ra, dec, mag in zip(
        epochs, ras.tolist(), decs.tolist(), magnitude.tolist(), strict=True
    ):
        # Rounding may lead to 360, which the standard excludes.
        yield "ANGLE_1", epoch, _number(round(ra, _ANGLE_DIGITS) % 360, _ANGLE_DIGITS)
        yield "ANGLE_2", epoch, _number(dec, _ANGLE_DIGITS)
        if math.isfinite(mag):
            yield "MAG", epoch, _number(mag, _MAG_DIGITS)


def _comments(rows: NDArray[np.void], parameters: TrackingDataParameters) -> list[str]:
    lines = [
        "Angles are measurements against the attitude of the camera, axes ICRS; no correction is"
        " applied for light time, aberration or refraction",
        "Time tags are the middle of the exposure",
    ]
    if parameters.time_sigma_s:
        lines.append(f"TIME_SIGMA {parameters.time_sigma_s:g} s")
    return lines


def _sigmas(rows: NDArray[np.void], epochs: list[str]) -> list[str]:
    """Comments with the std of every direction that has one, and with the rms of them all."""
    sigmas = np.column_stack([rows["sigma_ra"], rows["sigma_dec"]])
    known = np.isfinite(sigmas).all(axis=1)
    if not known.any():
        return ["SIGMA unknown"]
    rms = np.sqrt(np.mean(np.square(sigmas[known]), axis=0))
    return [
        "SIGMA epoch, std of ANGLE_1 times cos ANGLE_2 and of ANGLE_2, arcsec",
        f"SIGMA rms {_arcsec(rms[0])} {_arcsec(rms[1])}",
        *(
            f"SIGMA {epochs[row]} {_arcsec(ra)} {_arcsec(dec)}"
            for row, (ra, dec) in zip(np.flatnonzero(known), sigmas[known].tolist(), strict=True)
        ),
    ]


def _times(stamps_ns: NDArray[np.int64]) -> list[str]:
    """The same as `utc`, of many times at once, as the standard writes them."""
    return list(np.datetime_as_string(((stamps_ns + 500) // 1000).astype("M8[us]")).tolist())


def _arcsec(angle: float) -> str:
    return _number(angle / _ARCSEC, _SIGMA_DIGITS)


def _number(value: float, digits: int) -> str:
    """Fixed-point; the standard knows no -0."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def _words(text: str) -> str:
    """Several blanks are the same as one."""
    return " ".join(text.split())


def _pair(key: str, value: str) -> str:
    return f"{key:<15} = {value}"


def _comment(text: str) -> str:
    return f"COMMENT {text}"


def _fill(element: ET.Element, comments: list[str], pairs: _Pairs) -> None:
    for tag, text in [*(("COMMENT", comment) for comment in comments), *pairs]:
        ET.SubElement(element, tag).text = text
