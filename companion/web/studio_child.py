"""The worker process for recordings: decodes pictures, and looks at them with one or two settings.

Started by ``companion.web.studio`` as ``python -m companion.web.studio_child SOCKET_FD``. Requests and answers are JSON
behind their length; an answer may carry bytes. It ends when its socket is closed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from companion.config import Config
from companion.errors import CompanionError, SourceError
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport
from companion.web.clips import Clip, open_clip
from companion.web.overlay import Projection, details_view, detection_view
from companion.web.pictures import encode_jpeg

HEADER: Final = struct.Struct("<II")
"""Lengths of the JSON and of the bytes behind it."""
_LOWER_PRIORITY: Final = 15
_FIRST_TIME_NS: Final = 1_000_000_000
"""Times begin here: 0 would be before the first pose can be as old as it may."""


def main() -> int:
    """Serve requests until the socket is closed; return the exit status."""
    for number in (signal.SIGINT, signal.SIGTERM):  # whoever started this process closes the socket
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_LOWER_PRIORITY)  # flying comes first
    bench = _Bench()
    with socket.socket(fileno=int(sys.argv[1])) as connection, connection.makefile("rwb") as stream:
        while head := stream.read(HEADER.size):
            length, _ = HEADER.unpack(head)
            request = json.loads(stream.read(length))
            answer, data = _answer(bench, request)
            text = json.dumps(answer, separators=(",", ":")).encode()
            stream.write(HEADER.pack(len(text), len(data)) + text + data)
            stream.flush()
    return 0


def _answer(bench: _Bench, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
    try:
        match request["do"]:
            case "about":
                return bench.about(request["path"]), b""
            case "picture":
                return {}, bench.picture(
                    request["path"], request["number"], request["width_px"], request["quality"]
                )
            case "compare":
                return bench.compare(
                    request["path"], request["first"], request["last"], request["configs"]
                ), b""
            case "advance":
                return bench.advance(request["budget_s"]), b""
            case other:
                return {"error": f"{other} is nothing that is done here"}, b""
    except CompanionError as error:
        return {"error": str(error)}, b""
    except Exception as error:  # noqa: BLE001  one recording that breaks a decoder must not take the next one with it
        traceback.print_exc()
        return {"error": f"{type(error).__name__}: {error}"}, b""


class _Bench:
    """The recording that lies open, and the comparison that runs on it."""

    def __init__(self) -> None:
        self._path = ""
        self._clip: Clip | None = None
        self._comparison: Comparison | None = None

    def about(self, path: str) -> dict[str, Any]:
        clip = self._open(path)
        first = next(
            (image for n in range(min(5, len(clip.times_ns))) if (image := clip.picture(n)) is not None), None
        )
        if first is None:
            raise SourceError(f"{Path(path).name}: the first pictures cannot be decoded")
        height_px, width_px = first.shape
        return {
            "pictures": len(clip.times_ns),
            "times_s": [round(time_ns / 1e9, 3) for time_ns in clip.times_ns],
            "width_px": width_px,
            "height_px": height_px,
            "has_poses": clip.has_poses,
            "has_camera_file": bool(clip.camera_file),
        }

    def picture(self, path: str, number: int, width_px: int, quality: int) -> bytes:
        clip = self._open(path)
        if not 0 <= number < len(clip.times_ns):
            raise SourceError(f"found picture {number}; allowed: 0 to {len(clip.times_ns) - 1}")
        image = clip.picture(number)
        if image is None:
            raise SourceError(f"picture {number} cannot be decoded")
        return encode_jpeg(image, width_px=width_px, quality=quality)

    def compare(self, path: str, first: int, last: int, configs: list[str]) -> dict[str, Any]:
        self._comparison = None
        clip = open_clip(Path(path))
        if not 0 <= first <= last < len(clip.times_ns):
            raise SourceError(
                f"found pictures {first} to {last}; allowed: within 0 to {len(clip.times_ns) - 1}"
            )
        self._comparison = Comparison(
            clip, first, last, [Config.model_validate_json(text) for text in configs]
        )
        return {}

    def advance(self, budget_s: float) -> dict[str, Any]:
        comparison = self._comparison
        if comparison is None:
            return {"rows": [], "done": True}
        rows = comparison.advance(budget_s)
        if comparison.is_done:
            self._comparison = None
        return {"rows": rows, "done": comparison.is_done}

    def _open(self, path: str) -> Clip:
        if self._clip is None or path != self._path:
            if self._clip is not None:
                self._clip.close()
                self._clip = None
            self._clip = open_clip(Path(path))
            self._path = path
        return self._clip


class Comparison:
    """Looks at the pictures of a clip in their order, with each of the settings by turns.

    Parameters
    ----------
    clip
        It is closed at the end.
    first, last
        Pictures.
    configs
        One or two.
    """

    def __init__(self, clip: Clip, first: int, last: int, configs: list[Config]) -> None:
        from companion.vision.child import build_pipeline  # the detector: only where it is asked for

        self._clip = clip
        self._next = first
        self._last = last
        cameras = [
            # Where the settings name no camera file, the one beside the recording is meant.
            config.camera.model_copy(update={"file": clip.camera_file})
            if clip.camera_file and not config.camera.file
            else config.camera
            for config in configs
        ]
        self._lanes = [
            (build_pipeline(config.detector, camera), Projection(camera))
            for config, camera in zip(configs, cameras, strict=True)
        ]

    @property
    def is_done(self) -> bool:
        """Whether the last picture was looked at."""
        return self._next > self._last

    def advance(self, budget_s: float) -> list[dict[str, Any]]:
        """Look at pictures until the time is used up; return a row of each."""
        until_s = time.monotonic() + budget_s
        rows: list[dict[str, Any]] = []
        while not self.is_done and (not rows or time.monotonic() < until_s):
            rows.append(self._look_at(self._next))
            self._next += 1
        if self.is_done:
            self._clip.close()
        return rows

    def _look_at(self, number: int) -> dict[str, Any]:
        clip = self._clip
        image = clip.picture(number)
        if image is None:
            return {"number": number, "lanes": [None] * len(self._lanes)}
        time_ns = _FIRST_TIME_NS + clip.times_ns[number]
        pose = clip.pose(number)
        height_px, width_px = image.shape
        lanes: list[dict[str, Any]] = []
        for pipeline, projection in self._lanes:
            report = pipeline.detect(Frame(image, time_ns, number), pose)
            fields, arrays = pipeline.details()
            pipeline.between_frames()
            size_px = (width_px, height_px)
            attitude = None if pose is None else pose.q_ned_from_body
            details = {"frame_seq": number, "frame_ns": time_ns, **fields}
            lanes.append(
                {
                    "detection": detection_view(_finite(report), projection, size_px),
                    "details": details_view(details, arrays, projection, attitude, size_px),
                }
            )
        return {"number": number, "lanes": lanes}


def _finite(report: DetectionReport) -> dict[str, Any]:
    """Return a report's fields; numbers that JSON does not know are left out."""
    return {
        name: value
        for name, value in asdict(report).items()
        if not (isinstance(value, float) and not math.isfinite(value))
    }


if __name__ == "__main__":
    sys.exit(main())
