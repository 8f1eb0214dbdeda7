"""Closed-loop flights: a world, a camera, a vehicle, a planner that knows nothing of obstacles, and the real service.

A flight runs in simulated time (``lockstep_flight``), where it repeats bit for bit, or in real time
(``realtime_flight``), where it shows what the machine can do. The vehicle starts on the ground, takes off in
OFFBOARD to the height of the flight, and its planner then streams the goal: time, path and figures count from there.

With ``method="off"`` there is no service: the planner speaks to the autopilot. That is what the vehicle would do
without this project; a service that is there and disengaged would still pass every setpoint on unchanged.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np

from companion.errors import CompanionError
from companion.run_statistics import percentiles
from companion.sim.estimate_errors import EstimateErrors
from companion.sim.flight_place import Place
from companion.sim.flight_record import FlightRecord
from companion.sim.flight_referee import Outcome, Rules
from companion.sim.frame_faults import FrameFaults
from companion.sim.image_effects import ImageEffects
from companion.sim.vehicle import Vector3

Rival = Literal["straight", "flow_balance", "line_vp"]
Method = Literal["paper", "parallax", Rival, "off"]
RIVALS: Final = get_args(Rival)
PlannerKind = Literal["waypoints", "mavsdk"]
"""``waypoints``: ``companion.sim.planner``. ``mavsdk``: an unmodified mavsdk client, in real time only."""

_DIRECTIONS = ("gap", "vanishing_point", "lowest_flow")
_SECTOR_STEP_RAD = math.radians(3.0)


class FlightError(CompanionError):
    """A flight cannot be flown as it was asked for, or the simulation itself failed."""


@dataclass(frozen=True, slots=True)
class FlightSpec:
    """Everything that decides a flight. The same specification gives the same flight in simulated time.

    Attributes
    ----------
    world
        Name of a built-in world, path of a world's file, or ``random``.
    difficulty
        Of a random world.
    seed
        Of the random world, the camera's noise and the estimate's errors.
    method
        ``paper``: the service with the detector's default preset. ``parallax``: the service with the void map. ``straight``, ``flow_balance``, ``line_vp``:
        rivals for scale in place of the paper's detector (``companion.sim.rivals``), in simulated time only. ``off``: no service.
    planner
        Who streams setpoints.
    realtime
        Real time instead of simulated time.
    width_px, height_px, hfov_deg
        Of the camera.
    frame_rate_hz
        Frames, and so decisions, a second at most.
    detection_s
        Simulated time: what the detector takes for a frame. Real time: not used.
    planner_hz
        Setpoints a second.
    time_limit_s
        After which a flight is a ``timeout``; None: as the world has it.
    estimate
        Errors of the autopilot's estimate.
    image
        What the camera does to its pictures: noise, vignetting, motion blur, brightness.
    frame_drop_rate, frame_latency_s, frame_jitter_s
        Share of frames that never come; from exposure to hand-over, and up to how much longer. In simulated time no
        frame may take as long as it is to the next.
    settings
        Of the service, by table and key, over those that a flight has anyway.
    """

    world: str = "room"
    difficulty: str = "medium"
    seed: int = 0
    method: Method = "parallax"
    planner: PlannerKind = "waypoints"
    realtime: bool = False
    width_px: int = 320
    height_px: int = 240
    hfov_deg: float = 75.0
    frame_rate_hz: float = 5.0
    detection_s: float = 0.06
    planner_hz: float = 20.0
    time_limit_s: float | None = None
    estimate: EstimateErrors = field(default_factory=EstimateErrors)
    image: ImageEffects = field(default_factory=ImageEffects)
    frame_drop_rate: float = 0.0
    frame_latency_s: float = 0.0
    frame_jitter_s: float = 0.0
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise FlightError(f"method: found {self.method!r}; allowed: {', '.join(get_args(Method))}")
        if self.planner not in get_args(PlannerKind):
            raise FlightError(f"planner: found {self.planner!r}; allowed: {', '.join(get_args(PlannerKind))}")
        if self.planner == "mavsdk" and not self.realtime:
            raise FlightError(
                "the mavsdk planner keeps its own time: it flies in real time only (--realtime)"
            )
        if self.realtime and self.method in RIVALS:
            raise FlightError(
                f"{self.method} is a rival for scale: it flies in simulated time only (no --realtime)"
            )
        limits: dict[str, tuple[float, float]] = {
            "seed": (0, 2**32 - 1),
            "width_px": (64, 4096),
            "height_px": (48, 4096),
            "hfov_deg": (50.0, 150.0),
            "frame_rate_hz": (0.5, 60.0),
            "detection_s": (0.0, 5.0),
            "planner_hz": (2.0, 200.0),
            "time_limit_s": (1.0, 3600.0),
            "frame_drop_rate": (0.0, 1.0),
            "frame_latency_s": (0.0, 2.0),
            "frame_jitter_s": (0.0, 2.0),
        }
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise FlightError(f"{name}: found {value}; allowed: {least:g} to {most:g}")
        longest_s = self.frame_latency_s + self.frame_jitter_s
        if not self.realtime and longest_s >= 1.0 / self.frame_rate_hz:
            raise FlightError(
                f"frame_latency_s and frame_jitter_s: found {longest_s:g} together; allowed in simulated time: less "
                f"than the {1.0 / self.frame_rate_hz:g} s between two frames"
            )

    @property
    def frame_faults(self) -> FrameFaults:
        """Which frames are lost or late."""
        return FrameFaults(self.frame_drop_rate, self.frame_latency_s, self.frame_jitter_s, self.seed)

    def rules_for(self, place: Place) -> Rules:
        """Return when a flight there ends."""
        return Rules(place.time_limit_s if self.time_limit_s is None else self.time_limit_s)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FlightSpec:
        """Read what ``as_dict`` gave."""
        parts = {
            "estimate": EstimateErrors(**values["estimate"]),
            "image": ImageEffects(**values["image"]),
        }
        return cls(**{**values, **parts})


@dataclass(frozen=True, slots=True)
class FlightResult:
    """What became of a flight.

    Attributes
    ----------
    world, seed, method
        Which flight it was.
    outcome
        ``reached``, ``collided``, ``stuck`` or ``timeout``.
    time_s, path_m
        From the setpoint that first named the goal to the end.
    min_clearance_m
        Least distance from the vehicle's hull to anything.
    collisions
        Contacts; the first one ends a flight.
    decisions
        Answers of the detector, ``none`` included.
    answers
        How many of each kind.
    free_ratio_median
        Over all directions answered: true free distance there / the greatest in the field of view; None without any.
    states
        Seconds in each state of the service.
    max_setpoint_gap_s
        Longest time that the autopilot was without a setpoint.
    frame_to_setpoint_ms
        Age of a frame when the first setpoint after its answer was decided, p50 and p95.
    goal_distance_m
        From the last position to the goal.
    realtime_factor
        Simulated seconds in a real one, take-off included and start-up left out.
    """

    world: str
    seed: int
    method: str
    outcome: Outcome
    time_s: float
    path_m: float
    min_clearance_m: float
    collisions: int
    decisions: int
    answers: Mapping[str, int]
    free_ratio_median: float | None
    states: Mapping[str, float]
    max_setpoint_gap_s: float
    frame_to_setpoint_ms: Mapping[str, float | None]
    goal_distance_m: float
    realtime_factor: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class FlownFlight:
    """A flight as it was flown: its ending and its record.

    Attributes
    ----------
    outcome
        How it ended.
    record
        What happened.
    frame_to_setpoint_ms
        As the service says; empty without it.
    realtime_factor
        Simulated seconds in a real one.
    """

    outcome: Outcome
    record: FlightRecord
    realtime_factor: float
    frame_to_setpoint_ms: Mapping[str, float | None] = field(default_factory=lambda: percentiles(()))


def run_flight(spec: FlightSpec, place: Place | None = None, *, record: Path | None = None) -> FlightResult:
    """Fly.

    Parameters
    ----------
    spec
        Which flight.
    place
        Where; by default the world that the specification names.
    record
        Write its record (``flight_record.FlightRecord``) there.

    Raises
    ------
    companion.errors.CompanionError
        When the world cannot be used or the simulation itself failed.
    """
    result, kept = fly_and_judge(spec, place if place is not None else place_of(spec))
    if record is not None:
        kept.save(record)
    return result


def fly_and_judge(spec: FlightSpec, place: Place) -> tuple[FlightResult, FlightRecord]:
    """Fly, and return the result and the record, which knows both (``about``).

    Raises
    ------
    companion.errors.CompanionError
        When the simulation itself failed.
    """
    flown = fly(spec, place)
    result = judged(spec, place, flown)
    about = {"spec": spec.as_dict(), "result": result.as_dict()}
    return result, dataclasses.replace(flown.record, about=about)


def fly(spec: FlightSpec, place: Place) -> FlownFlight:
    """Fly at a place, in the specification's kind of time."""
    if spec.realtime:
        from companion.sim.realtime_flight import fly_in_real_time

        return fly_in_real_time(spec, place)
    from companion.sim.lockstep_flight import fly_in_lockstep

    return fly_in_lockstep(spec, place)


def judged(spec: FlightSpec, place: Place, flown: FlownFlight) -> FlightResult:
    """Return the figures of a flight."""
    record = flown.record
    kinds = record.answer_kind.tolist()
    ratios = free_ratios(spec, place, record)
    return FlightResult(
        world=place.name,
        seed=spec.seed,
        method=spec.method,
        outcome=flown.outcome,
        time_s=round(record.duration_s, 2),
        path_m=round(record.path_m, 2),
        min_clearance_m=round(float(record.clearance_m.min(initial=math.inf)), 3),
        collisions=int(flown.outcome == "collided"),
        decisions=len(kinds),
        answers={kind: kinds.count(kind) for kind in sorted(set(kinds))},
        free_ratio_median=round(statistics.median(ratios), 3) if ratios else None,
        states=record.seconds_in_states(),
        max_setpoint_gap_s=round(record.longest_setpoint_gap_s(), 3),
        frame_to_setpoint_ms=flown.frame_to_setpoint_ms,
        goal_distance_m=round(math.dist(record.position_ned_m[-1].tolist(), place.goal_ned_m), 2),
        realtime_factor=round(flown.realtime_factor, 2),
    )


def free_ratios(spec: FlightSpec, place: Place, record: FlightRecord) -> list[float]:
    """Return, for each direction answered, the free distance along it over the greatest in the field of view."""
    # Azimuth of a column, with the camera level: a pinhole with the principal point in the middle.
    focal_px = spec.width_px / 2.0 / math.tan(math.radians(spec.hfov_deg) / 2.0)
    steps = math.floor(math.radians(spec.hfov_deg) / 2.0 / _SECTOR_STEP_RAD)
    sector_rad = _SECTOR_STEP_RAD * np.arange(-steps, steps + 1)
    ratios: list[float] = []
    for kind, frame_s, (x_px, _) in zip(
        record.answer_kind.tolist(),
        record.answer_frame_time_s.tolist(),
        record.answer_px.tolist(),
        strict=True,
    ):
        if kind not in _DIRECTIONS or frame_s < 0.0 or not math.isfinite(x_px):
            continue
        sample = record.sample_at(frame_s)
        north, east, down = record.position_ned_m[sample].tolist()
        position: Vector3 = (north, east, down)
        chosen_rad = math.atan((x_px - (spec.width_px - 1) / 2.0) / focal_px)
        azimuths_rad = record.heading_rad[sample] + np.append(sector_rad, chosen_rad)
        free_m = place.free_distances_m(position, azimuths_rad)
        ratios.append(float(free_m[-1] / free_m.max()) if free_m.max() > 0.0 else 1.0)
    return ratios


def place_of(spec: FlightSpec) -> Place:
    """Return the place of a specification's world.

    Raises
    ------
    companion.errors.CompanionError
        When there is no such world, or its file cannot be used.
    """
    from companion.sim.flight_worlds import find_world, place_in

    return place_in(find_world(spec.world, seed=spec.seed, difficulty=spec.difficulty))
