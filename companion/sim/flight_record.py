"""What happened on a flight, sample by sample: for its figures, its picture, its video, and for comparison.

Everything is in columns of numpy arrays, so that a flight is a small file and two flights are compared at a glance.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from companion.errors import CompanionError
from companion.guidance.observation import Pose
from companion.sim.autopilot_endpoint import SetpointRecord
from companion.sim.companion_process import Event
from companion.sim.planner import Waypoint

Floats = NDArray[np.float64]

_NAN3: Final = (math.nan, math.nan, math.nan)
NO_STATE: Final = ""
"""State of a flight without the service, or before it has said one."""


@dataclass(frozen=True)
class FlightRecord:
    """A flight in columns: N samples of the vehicle, D answers of the detector, C changes of state.

    Times are seconds since the first sample; positions are local NED, m; what is not known is NaN.

    Attributes
    ----------
    time_s
        (N,).
    position_ned_m
        (N, 3), where the vehicle really was.
    q_ned_from_body
        (N, 4), its real attitude.
    clearance_m
        (N,), from its hull to the nearest thing.
    planned_ned_m
        (N, 3), the planner's newest setpoint.
    sent_ned_m, sent_yaw_rad
        (N, 3) and (N,), the newest setpoint that reached the autopilot; NaN yaw: none was commanded.
    answer_time_s, answer_frame_time_s
        (D,), when an answer of the detector came, and when its frame was exposed.
    answer_kind, answer_reason
        (D,) text: ``vanishing_point``, ``lowest_flow``, ``single_plane`` or ``none`` and why.
    answer_px
        (D, 2), the direction in the image.
    answer_distance_m
        (D,), measured free distance along it.
    state_time_s, state, state_reason
        (C,), when the service's state changed, to which, and why; the first one is that at the start.
    setpoint_time_s
        (S,), when setpoints reached the autopilot.
    setpoint_bytes
        (B,) uint8, all those frames as they came, one after the other.
    about
        What else is worth knowing, such as the flight's specification and result.
    """

    time_s: Floats
    position_ned_m: Floats
    q_ned_from_body: Floats
    clearance_m: Floats
    planned_ned_m: Floats
    sent_ned_m: Floats
    sent_yaw_rad: Floats
    answer_time_s: Floats
    answer_frame_time_s: Floats
    answer_kind: NDArray[np.str_]
    answer_reason: NDArray[np.str_]
    answer_px: Floats
    answer_distance_m: Floats
    state_time_s: Floats
    state: NDArray[np.str_]
    state_reason: NDArray[np.str_]
    setpoint_time_s: Floats
    setpoint_bytes: NDArray[np.uint8]
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def duration_s(self) -> float:
        """Time between the first and the last sample."""
        return float(self.time_s[-1]) if len(self.time_s) else 0.0

    @property
    def heading_rad(self) -> Floats:
        """(N,) azimuth of the body's forward axis."""
        w, x, y, z = self.q_ned_from_body.T
        heading: Floats = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return heading

    @property
    def path_m(self) -> float:
        """Length of the way flown."""
        return float(np.linalg.norm(np.diff(self.position_ned_m, axis=0), axis=1).sum())

    def sample_at(self, time_s: float) -> int:
        """Return the index of the sample nearest to a time."""
        after = int(np.searchsorted(self.time_s, time_s))
        before = max(0, after - 1)
        after = min(after, len(self.time_s) - 1)
        return before if time_s - self.time_s[before] <= self.time_s[after] - time_s else after

    def state_at(self, time_s: float) -> str:
        """Return the service's state at a time, "" without one."""
        place = int(np.searchsorted(self.state_time_s, time_s, side="right"))
        return str(self.state[place - 1]) if place else NO_STATE

    def seconds_in_states(self) -> dict[str, float]:
        """Return how long each state lasted, by name, rounded to 0.01 s."""
        ends = [*self.state_time_s.tolist(), self.duration_s][1:]
        seconds: dict[str, float] = {}
        for name, begin_s, end_s in zip(self.state.tolist(), self.state_time_s.tolist(), ends, strict=True):
            lasted_s = max(0.0, end_s - max(0.0, begin_s))
            seconds[name] = seconds.get(name, 0.0) + lasted_s
        return {name: round(value, 2) for name, value in sorted(seconds.items()) if value > 0.0}

    def longest_setpoint_gap_s(self) -> float:
        """Return the longest time without a setpoint at the autopilot, from the first to the end."""
        if not len(self.setpoint_time_s):
            return self.duration_s
        return float(np.diff([*self.setpoint_time_s.tolist(), self.duration_s]).max())

    def equals(self, other: FlightRecord) -> bool:
        """Return whether two flights are the same to the last bit; ``about`` is not compared."""
        names = [f.name for f in fields(self) if f.name != "about"]
        mine, theirs = ([getattr(record, name) for name in names] for record in (self, other))
        return all(
            a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
            for a, b in zip(mine, theirs, strict=True)
        )

    def save(self, path: Path) -> None:
        """Write a compressed ``.npz``.

        Raises
        ------
        companion.errors.CompanionError
            When the file cannot be written.
        """
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "about"}
        try:
            with path.open("wb") as file:
                np.savez_compressed(file, about=np.array(json.dumps(dict(self.about))), **columns)
        except OSError as error:
            raise CompanionError(f"{path}: cannot be written: {error.strerror}") from error

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what ``save`` wrote.

        Raises
        ------
        companion.errors.CompanionError
            When the file is not there or is no record.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                columns = {f.name: stored[f.name] for f in fields(cls) if f.name != "about"}
                return cls(**columns, about=json.loads(str(stored["about"])))
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise CompanionError(f"{path}: not a flight record: {error}") from error


class FlightRecorder:
    """Gathers a flight's samples and events while it flies."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, ...]] = []
        self._answers: list[tuple[float, float, str, str, float, float, float]] = []
        self._states: list[tuple[float, str, str]] = []
        self._begin_ns: int | None = None

    def begin(self, now_ns: int) -> None:
        """Start the flight's time here; what happened before is left out, but for the state it led to."""
        self._begin_ns = now_ns
        self._samples.clear()
        self._answers.clear()
        self._states = [(0.0, *self._states[-1][1:])] if self._states else []

    def sample(
        self,
        pose: Pose,
        now_ns: int,
        *,
        clearance_m: float,
        planned: Waypoint | None,
        sent: SetpointRecord | None,
    ) -> None:
        """Take one sample of the vehicle."""
        planned_m = _NAN3 if planned is None else (planned.north_m, planned.east_m, planned.down_m)
        sent_m, yaw_rad = _NAN3, math.nan
        if sent is not None:
            used = sent.setpoint.used_fields()
            sent_m = (used.get("x", math.nan), used.get("y", math.nan), used.get("z", math.nan))
            yaw_rad = used.get("yaw", math.nan)
        position = (pose.north_m, pose.east_m, pose.down_m)
        self._samples.append(
            (
                self._since_s(now_ns),
                *position,
                *pose.q_ned_from_body,
                clearance_m,
                *planned_m,
                *sent_m,
                yaw_rad,
            )
        )

    def on_event(self, event: Event, now_ns: int) -> None:
        """Take one event of the service's log."""
        match event.get("event"):
            case "state":
                self._states.append((self._since_s(now_ns), event["state"], event["reason"]))
            case "detection":
                came_s = self._since_s(now_ns)
                self._answers.append(
                    (
                        came_s,
                        came_s - event["age_ms"] / 1e3,
                        event["kind"],
                        event.get("reason", ""),
                        event.get("x_px", math.nan),
                        event.get("y_px", math.nan),
                        event.get("distance_m", math.nan),
                    )
                )

    def record(self, setpoints: list[SetpointRecord], about: Mapping[str, Any]) -> FlightRecord:
        """Return the flight so far.

        Parameters
        ----------
        setpoints
            All that the autopilot received; those from before the beginning are left out.
        about
            Kept with the record.
        """
        begin_ns = self._begin_ns if self._begin_ns is not None else 0
        samples = np.array(self._samples, dtype=np.float64).reshape(-1, 16)
        answers = list(zip(*self._answers, strict=True)) if self._answers else [()] * 7
        states = list(zip(*self._states, strict=True)) if self._states else [()] * 3
        received = [setpoint for setpoint in setpoints if setpoint.time_ns >= begin_ns]
        return FlightRecord(
            time_s=samples[:, 0].copy(),
            position_ned_m=samples[:, 1:4].copy(),
            q_ned_from_body=samples[:, 4:8].copy(),
            clearance_m=samples[:, 8].copy(),
            planned_ned_m=samples[:, 9:12].copy(),
            sent_ned_m=samples[:, 12:15].copy(),
            sent_yaw_rad=samples[:, 15].copy(),
            answer_time_s=np.array(answers[0], np.float64),
            answer_frame_time_s=np.array(answers[1], np.float64),
            answer_kind=np.array(answers[2], np.str_),
            answer_reason=np.array(answers[3], np.str_),
            answer_px=np.array([answers[4], answers[5]], np.float64).T.reshape(-1, 2),
            answer_distance_m=np.array(answers[6], np.float64),
            state_time_s=np.array(states[0], np.float64),
            state=np.array(states[1], np.str_),
            state_reason=np.array(states[2], np.str_),
            setpoint_time_s=np.array([self._since_s(s.time_ns) for s in received], np.float64),
            setpoint_bytes=np.frombuffer(b"".join(s.raw for s in received), np.uint8),
            about=dict(about),
        )

    def _since_s(self, now_ns: int) -> float:
        return (now_ns - (self._begin_ns if self._begin_ns is not None else now_ns)) / 1e9
