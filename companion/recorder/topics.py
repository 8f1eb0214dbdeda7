"""How messages of the feed lie in a recording: topics, schemas, encodings.

Poses and log lines are in Foxglove's own schemas as JSON, frames in ROS's ``sensor_msgs/msg/CompressedImage`` (CDR), which
Foxglove shows too and which holds pixels as they are; everything else is JSON with a schema of its own, and MAVLink frames
are bytes. https://mcap.dev/spec/registry, https://docs.foxglove.dev/docs/visualization/message-schemas/introduction

``log_time`` is wall time in ns: our monotonic time plus an offset that is fixed when the recording begins (metadata
``void-companion``), so that a clock that is set meanwhile moves nothing. ``sequence`` counts what the feed published.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from companion.io.messages import Kind

IMAGE: Final = "/camera/image"
TRANSFORM: Final = "/tf"
MAVLINK_ENCODING: Final = "x-mavlink"
METADATA: Final = "void-companion"

_NS: Final = 1_000_000_000
_LEVELS: Final = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5}


@dataclass(frozen=True, slots=True)
class Topic:
    """A channel of a recording.

    Attributes
    ----------
    name
        Of the topic.
    schema
        Name of the schema; "" for none.
    """

    name: str
    schema: str


TOPICS: Final[Mapping[Kind, Topic]] = {
    Kind.FRAME: Topic("/camera/frames", "void.Frame"),
    Kind.POSE: Topic("/pose", "foxglove.PoseInFrame"),
    Kind.SETPOINT: Topic("/setpoints", "void.Setpoint"),
    Kind.DETECTION: Topic("/detections", "void.Detection"),
    Kind.STATE: Topic("/state", "void.State"),
    Kind.STATUS: Topic("/status", "void.Status"),
    Kind.LINK: Topic("/links", "void.Link"),
    Kind.LOG: Topic("/log", "foxglove.Log"),
    Kind.LOOP: Topic("/loops", "void.Loop"),
    Kind.CONFIG: Topic("/config", "void.Config"),
    Kind.CONTROL: Topic("/control", "void.Control"),
}
"""Where the kinds go that are JSON."""

_TIME: Final = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}
_VECTOR: Final = {
    "type": "object",
    "title": "foxglove.Vector3",
    "properties": {axis: {"type": "number"} for axis in "xyz"},
}
_QUATERNION: Final = {
    "type": "object",
    "title": "foxglove.Quaternion",
    "properties": {axis: {"type": "number"} for axis in "xyzw"},
}
_NUMBER: Final = {"type": "number"}
_TEXT: Final = {"type": "string"}
_NUMBERS: Final = {"type": "array", "items": _NUMBER}

_PROPERTIES: Final[Mapping[str, Mapping[str, Any]]] = {
    "foxglove.PoseInFrame": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "pose": {
            "type": "object",
            "title": "foxglove.Pose",
            "properties": {"position": _VECTOR, "orientation": _QUATERNION},
        },
        "speed_m_s": _NUMBER,
    },
    "foxglove.FrameTransform": {
        "timestamp": _TIME,
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _VECTOR,
        "rotation": _QUATERNION,
    },
    "foxglove.Log": {
        "timestamp": _TIME,
        "level": {"type": "integer"},
        "message": _TEXT,
        "name": _TEXT,
        "file": _TEXT,
        "line": {"type": "integer"},
    },
    "void.Frame": {"seq": _NUMBER, "width_px": _NUMBER, "height_px": _NUMBER},
    "void.Setpoint": {
        "planner": _TEXT,
        "state": _TEXT,
        "action": _TEXT,
        "planned": _NUMBERS,
        "sent": _NUMBERS,
        "yaw_deg": _NUMBER,
        "dropped": _TEXT,
    },
    "void.Detection": {
        "frame_seq": _NUMBER,
        "kind": _TEXT,
        "reason": _TEXT,
        "x_px": _NUMBER,
        "y_px": _NUMBER,
        "distance_m": _NUMBER,
        "confidence": _NUMBER,
        "detector_s": _NUMBER,
    },
    "void.State": {"previous": _TEXT, "state": _TEXT, "reason": _TEXT},
    "void.Status": {
        "state": _TEXT,
        "reason": _TEXT,
        "frames_hz": _NUMBER,
        "reports_hz": _NUMBER,
        "setpoints_hz": _NUMBER,
        "pose_age_ms": _NUMBER,
        "heading_deg": _NUMBER,
    },
    "void.Link": {"link": _TEXT, "url": _TEXT, "state": _TEXT},
    "void.Loop": {"name": _TEXT},
    "void.Config": {"active": {"type": "object"}, "set": {"type": "object"}},
    "void.Control": {"name": _TEXT},
}
"""Properties of the JSON schemas; an object may hold more than is listed."""

IMAGE_SCHEMA: Final = "sensor_msgs/msg/CompressedImage"
IMAGE_DEFINITION: Final = """std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def json_schema(name: str) -> bytes:
    """Return a JSON schema by its name."""
    return json.dumps({"title": name, "type": "object", "properties": _PROPERTIES[name]}).encode()


def timestamp(wall_ns: int) -> dict[str, int]:
    """Return wall time as Foxglove has it in JSON."""
    return {"sec": wall_ns // _NS, "nsec": wall_ns % _NS}


def pose_in_frame(fields: Mapping[str, Any], wall_ns: int) -> dict[str, Any]:
    """Return ``foxglove.PoseInFrame`` of a pose: body FRD in local NED."""
    w, x, y, z = fields["q_ned_from_body"]
    return {
        "timestamp": timestamp(wall_ns),
        "frame_id": "local_ned",
        "pose": {
            "position": {"x": fields["north_m"], "y": fields["east_m"], "z": fields["down_m"]},
            "orientation": {"x": x, "y": y, "z": z, "w": w},
        },
        "speed_m_s": fields["speed_m_s"],
    }


def body_transform(fields: Mapping[str, Any], wall_ns: int) -> dict[str, Any]:
    """Return ``foxglove.FrameTransform`` of a pose, for the 3D panel."""
    pose = pose_in_frame(fields, wall_ns)["pose"]
    return {
        "timestamp": timestamp(wall_ns),
        "parent_frame_id": "local_ned",
        "child_frame_id": "body_frd",
        "translation": pose["position"],
        "rotation": pose["orientation"],
    }


def up_transform(wall_ns: int) -> dict[str, Any]:
    """Return the transform of local NED in east, north, up: Foxglove's 3D panel has z upwards."""
    half = 0.5**0.5
    return {
        "timestamp": timestamp(wall_ns),
        "parent_frame_id": "local_enu",
        "child_frame_id": "local_ned",
        "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
        "rotation": {"x": half, "y": half, "z": 0.0, "w": 0.0},
    }


def log_entry(fields: Mapping[str, Any], wall_ns: int) -> dict[str, Any]:
    """Return ``foxglove.Log`` of a line of the log; its fields are in the message and beside it."""
    rest = {name: value for name, value in fields.items() if name not in ("event", "level", "time")}
    event = str(fields.get("event", ""))
    return {
        "timestamp": timestamp(wall_ns),
        "level": _LEVELS.get(str(fields.get("level")), 0),
        "message": f"{event} {json.dumps(rest)}" if rest else event,
        "name": event,
        "file": "",
        "line": 0,
        "fields": rest,
    }


def compressed_image(picture: bytes, format_name: str, wall_ns: int) -> bytes:
    """Return ``sensor_msgs/msg/CompressedImage`` in CDR (little endian)."""
    out = bytearray(struct.pack("<iI", wall_ns // _NS, wall_ns % _NS))
    for text in (b"camera\0", format_name.encode() + b"\0"):
        out += struct.pack("<I", len(text)) + text
        out += bytes(-len(out) % 4)
    out += struct.pack("<I", len(picture))
    return b"\x00\x01\x00\x00" + bytes(out) + picture


def picture_of(data: bytes) -> tuple[bytes, str]:
    """Return the picture and its format out of what `compressed_image` made.

    Raises
    ------
    ValueError
        When it is none.
    """
    try:
        at = 12
        texts = []
        for _ in range(2):
            (length,) = struct.unpack_from("<I", data, at)
            texts.append(data[at + 4 : at + 3 + length])
            at += 4 + length
            at += -(at - 4) % 4
        (length,) = struct.unpack_from("<I", data, at)
    except struct.error as error:
        raise ValueError(f"no compressed image: {error}") from error
    return data[at + 4 : at + 4 + length], texts[1].decode()
