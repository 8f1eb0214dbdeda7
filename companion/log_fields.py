"""Setpoints and reports as fields of log lines."""

from __future__ import annotations

import math
from typing import Any

from companion.guidance.observation import DetectionReport
from companion.guidance.setpoint import (
    Drop,
    Forward,
    LocalSetpoint,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Setpoint,
    Verdict,
)


def verdict_fields(setpoint: Setpoint, verdict: Verdict) -> dict[str, Any]:
    """Return what was asked for and what is sent, for the log and the status line."""
    planned = _planned(setpoint)
    fields: dict[str, Any] = {"planned": planned}
    match verdict:
        case Rewrite() | RewriteOffset():
            fields["action"] = verdict.action
            z = verdict.z if isinstance(verdict, RewriteOffset) and verdict.z is not None else planned[2]
            fields["sent"] = [round(verdict.x, 3), round(verdict.y, 3), round(z, 3)]
        case RewriteVelocity():
            fields["action"] = verdict.action
            fields["planned"] = [round(v, 3) for v in (setpoint.vx, setpoint.vy, setpoint.vz)]
            fields["sent"] = [round(verdict.vx, 3), round(verdict.vy, 3), round(setpoint.vz, 3)]
        case RewriteGlobal():
            fields["action"] = verdict.action
            fields["sent"] = [verdict.lat_int, verdict.lon_int, planned[2]]
        case Forward():
            fields["action"] = "forwarded"
            fields["sent"] = planned
        case Drop():
            fields["action"] = "dropped"
            fields["dropped"] = verdict.reason
    if isinstance(verdict, Rewrite | RewriteOffset | RewriteVelocity | RewriteGlobal):
        fields["yaw_deg"] = None if verdict.yaw is None else round(math.degrees(verdict.yaw), 1)
    return fields


def _planned(setpoint: Setpoint) -> list[float]:
    if isinstance(setpoint, LocalSetpoint):
        return [round(v, 3) for v in (setpoint.x, setpoint.y, setpoint.z)]
    return [setpoint.lat_int, setpoint.lon_int, round(setpoint.alt, 3)]


def report_fields(report: DetectionReport, now_ns: int) -> dict[str, Any]:
    """Return one report of the vision worker, for the log and the status line."""
    fields: dict[str, Any] = {
        "frame_seq": report.frame_seq,
        "kind": report.kind,
        "age_ms": round((now_ns - report.frame_ns) / 1e6),
        "detector_ms": round(1e3 * report.detector_s),
    }
    optional = {
        "reason": report.reason or None,
        "detail": report.detail or None,
        "x_px": report.x_px,
        "y_px": report.y_px,
        "baseline_m": report.baseline_m,
        "distance_m": report.distance_m,
        "confidence": report.confidence,
        "time_to_contact_frames": report.time_to_contact_frames,
        "time_to_contact_s": report.time_to_contact_s,
        "time_to_contact_spread_s": report.time_to_contact_spread_s,
    }
    for name, value in optional.items():
        if value is not None:
            fields[name] = round(value, 3) if isinstance(value, float) else value
    return fields
