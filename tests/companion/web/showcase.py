"""A flight for the page: the office walk's pictures and poses, looked at by the real detector, published again and again."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.config import Config
from companion.config_file import config_of, merged
from companion.config_reload_rules import changes_between
from companion.errors import ConfigError
from companion.frames.source import Frame
from companion.guidance.coordinates import heading_rad
from companion.guidance.observation import DetectionReport, Pose
from companion.io.messages import Answer, Kind, Message, Wants, pack_arrays
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA
from companion.vision.child import build_pipeline
from companion.web.clips import open_clip
from companion.web.sink import LivePage

FIRST = 98
"""From here on there is a gap, and a void map around it."""
WARM_UP = 5


class Looked:
    """One picture with its pose, and what the detector made of it."""

    def __init__(
        self,
        image: NDArray[np.uint8],
        pose: Pose,
        report: DetectionReport,
        fields: dict[str, Any],
        arrays: dict[str, NDArray[Any]],
    ) -> None:
        self.image, self.pose, self.report, self.fields, self.arrays = image, pose, report, fields, arrays


def look_at_the_walk(method: str, count: int) -> list[Looked]:
    """Run the real detector over pictures of the walk."""
    config = config_of(
        {"detector": {"method": method}, "camera": {"file": str(OFFICE_WALK_CAMERA)}}, name="showcase"
    )
    pipeline = build_pipeline(config.detector, config.camera)
    clip = open_clip(OFFICE_WALK)
    looked: list[Looked] = []
    for number in range(FIRST - WARM_UP, FIRST + count):
        image, pose = clip.picture(number), clip.pose(number)
        assert image is not None
        assert pose is not None
        time_ns = 10**9 + clip.times_ns[number]
        report = pipeline.detect(Frame(image, time_ns, number), pose)
        fields, arrays = pipeline.details()
        pipeline.between_frames()
        if number >= FIRST:
            looked.append(Looked(image, pose, report, fields, arrays))
    return looked


class FakeDesk:
    """Implements ``companion.io.sink.Desk`` with the rules of a reload, and nothing that flies."""

    def __init__(self, config: Config) -> None:
        self.active = config
        self.wants = Wants()
        self.asked: list[tuple[str, Mapping[str, Any]]] = []
        self.lines: list[tuple[str, dict[str, Any]]] = []
        self.dropped: Counter[Kind] = Counter()
        self.page: LivePage | None = None

    @property
    def log(self) -> FakeDesk:
        return self

    def info(self, event: str, **fields: Any) -> None:
        self.lines.append((event, fields))

    warning = info
    error = info

    def want(self, wants: Wants) -> None:
        self.wants = wants

    def ask(self, name: str, fields: Mapping[str, Any]) -> Future[Answer]:
        self.asked.append((name, fields))
        future: Future[Answer] = Future()
        table: dict[str, Any] = self.active.model_dump(exclude_unset=True)
        for key, value in fields["values"].items():
            section, _, leaf = key.partition(".")
            table = merged(table, {section: {leaf: value}})
        try:
            changes = changes_between(self.active, new := config_of(table, name="settings"))
        except ConfigError as error:
            future.set_result(Answer(accepted=False, reasons=(str(error),)))
            return future
        told = {"at_once": dict(changes.at_once), "new_worker": dict(changes.new_worker)}
        if changes.refused:
            future.set_result(Answer(accepted=False, fields={**told, "refused": dict(changes.refused)}))
            return future
        self.active = new
        if self.page is not None:
            self.page.take(config_message(new))
        future.set_result(Answer(accepted=True, fields=told))
        return future


def config_message(config: Config) -> Message:
    tables = {
        "active": config.model_dump(mode="json"),
        "set": config.model_dump(mode="json", exclude_unset=True),
    }
    return Message(Kind.CONFIG, time.monotonic_ns(), 1, tables)


class Showcase:
    """Publishes to a page at the camera's rate until it is stopped."""

    def __init__(
        self, page: LivePage, desk: FakeDesk, looked: list[Looked], *, rate_hz: float = 15.0
    ) -> None:
        self._page, self._desk, self._looked = page, desk, looked
        self._interval_s = 1.0 / rate_hz
        self._stop = threading.Event()
        self._number = 0
        self._noise = np.random.default_rng(7)
        self._seq = 0
        self._thread = threading.Thread(target=self._run, name="showcase")

    def __enter__(self) -> Showcase:
        self._history()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def put(self, kind: Kind, time_ns: int, fields: Mapping[str, Any], **more: Any) -> None:
        self._seq += 1
        if kind in self._desk.wants.kinds:
            self._page.take(Message(kind, time_ns, self._seq, fields, **more))

    def _history(self) -> None:
        now_ns = time.monotonic_ns()
        told = (
            (280, "DISENGAGED", "not armed"),
            (236, "FOLLOW", "void within 12 deg of the goal"),
            (171, "STEER", "void 24 deg left of the goal"),
            (120, "ALIGN", "goal out of view"),
            (112, "FOLLOW", "void within 12 deg of the goal"),
            (63, "TURN", "single plane at 1.4 m"),
            (48, "PROBE", "one step along a free bearing"),
            (41, "STEER", "void 31 deg right of the goal"),
        )
        previous = ""
        for ago_s, state, reason in told:
            at_ns = now_ns - ago_s * 10**9
            self.put(Kind.STATE, at_ns, {"previous": previous, "state": state, "reason": reason})
            self.put(
                Kind.LOG,
                at_ns,
                {
                    "event": "state",
                    "level": "info",
                    "time": f"2026-01-01T12:{ago_s // 60:02}:{ago_s % 60:02}Z",
                    "state": state,
                    "reason": reason,
                },
            )
            previous = state
        for ago in range(560, 0, -1):
            self._status(now_ns - ago * 5 * 10**8, ago)
        self.put(
            Kind.LOG,
            now_ns,
            {
                "event": "clock_refused",
                "level": "warning",
                "time": "2026-01-01T12:04:40Z",
                "offset_ns": 12_000_000,
                "round_trip_ns": 48_000_000,
            },
        )
        for name, url in (("planner0", "udpin:0.0.0.0:14551"), ("autopilot0", "serial:/dev/ttyAMA0:921600")):
            self.put(Kind.LINK, now_ns, {"link": name, "url": url, "state": "open"})

    def _status(self, now_ns: int, step: int) -> None:
        swing = float(np.clip(self._noise.normal(0.0, 0.5), -1.2, 1.2))
        looked = self._looked[step % len(self._looked)]
        self.put(
            Kind.STATUS,
            now_ns,
            {
                "state": "STEER",
                "reason": "void 31 deg right of the goal",
                "not_ready": None,
                "armed": True,
                "engaged": True,
                "frames_hz": 15 + 0.5 * swing,
                "reports_hz": 9.5 + swing,
                "setpoints_hz": 20.0,
                "pose_age_ms": 22 + 9 * swing,
                "heading_deg": 40.0,
                "worker": "busy",
                "worker_restarts": 0,
                "clock_round_trip_ms": 1.8,
                "report": {"age_ms": 190 + 60 * swing, "detector_ms": 1e3 * looked.report.detector_s},
                "links": {
                    name: {
                        "state": "open",
                        "received_bytes": 8_000_000 + 900 * step,
                        "sent_bytes": 2_000_000,
                        "drops": 0,
                        "sequence_gaps": 0,
                    }
                    for name in ("planner0", "autopilot0")
                },
            },
        )

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop.is_set():
            self._publish(time.monotonic_ns())
            due_s = max(due_s + self._interval_s, time.monotonic() - self._interval_s)
            self._stop.wait(max(0.0, due_s - time.monotonic()))

    def _publish(self, now_ns: int) -> None:
        number = self._number = self._number + 1
        place = number % max(1, 2 * len(self._looked) - 2)  # there and back again: nothing leaps
        looked = self._looked[place if place < len(self._looked) else 2 * len(self._looked) - 2 - place]
        pose, image = looked.pose, looked.image
        height_px, width_px = image.shape
        self.put(
            Kind.FRAME,
            now_ns,
            {
                "seq": number,
                "time_of": "exposure",
                "height_px": height_px,
                "width_px": width_px,
                "taken_ns": now_ns,
            },
            image=image,
        )
        place_of = {
            "north_m": pose.north_m,
            "east_m": pose.east_m,
            "down_m": pose.down_m,
            "q_ned_from_body": list(pose.q_ned_from_body),
        }
        self.put(Kind.POSE, now_ns, {**place_of, "speed_m_s": 0.62})
        azimuth = heading_rad(pose.q_ned_from_body)
        goal = [
            pose.north_m + 5.2 * math.cos(azimuth + 0.25),
            pose.east_m + 5.2 * math.sin(azimuth + 0.25),
        ]
        sent = [
            pose.north_m + 2.1 * math.cos(azimuth - 0.2),
            pose.east_m + 2.1 * math.sin(azimuth - 0.2),
        ]
        self.put(
            Kind.SETPOINT,
            now_ns,
            {
                "planner": "255/190",
                "state": "STEER",
                "action": "substituted",
                "goal_ned": goal,
                "decided_ned": sent,
            },
        )
        report = asdict(looked.report) | {"frame_seq": number, "frame_ns": now_ns}
        self.put(Kind.DETECTION, now_ns, report)
        layout, data = pack_arrays(looked.arrays)
        self.put(
            Kind.DETAILS,
            now_ns,
            {**looked.fields, "frame_seq": number, "frame_ns": now_ns, "arrays": layout},
            data=data,
        )
        if number % 7 == 0:
            self._status(now_ns, number)
