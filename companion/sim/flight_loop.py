"""The part of a flight that both kinds of time share: the service's configuration, taking off, watching."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Final, cast

from companion.clock import Clock
from companion.sim.autopilot import FakeAutopilot
from companion.sim.camera_feed import Renderer
from companion.sim.estimate_errors import ErringEstimate
from companion.sim.flight import RIVALS, FlightError, FlightSpec
from companion.sim.flight_place import Place
from companion.sim.flight_record import FlightRecorder
from companion.sim.flight_referee import Outcome, Referee
from companion.sim.image_effects import ImageEffects
from companion.sim.panda_camera import PandaCamera
from companion.sim.planner import Planner, Waypoint
from companion.sim.sensor_camera import SampledRenderer, SensorCamera
from companion.sim.vehicle import Vehicle, VehicleLimits
from detector.camera_model import CameraModel

Address = tuple[str, int]

_SAMPLE_NS: Final = 50_000_000
_TAKE_OFF_S: Final = 30.0
_AT_HEIGHT_M: Final = 0.25


def autopilot_of(spec: FlightSpec, place: Place, clock: Clock) -> FakeAutopilot:
    """Return the autopilot, its vehicle on the ground at the start."""
    north_m, east_m, _ = place.start_ned_m
    vehicle = Vehicle(
        VehicleLimits.indoor(), position_ned_m=(north_m, east_m, 0.0), yaw_rad=place.start_heading_rad
    )
    erring = ErringEstimate(spec.estimate, spec.seed)
    return FakeAutopilot(vehicle=vehicle, clock=clock, erring=erring)


def service_tables(spec: FlightSpec, autopilot: Address) -> dict[str, dict[str, Any]]:
    """Return the service's configuration for a flight with it, its frame source left out."""
    tables: dict[str, dict[str, Any]] = {
        "detector": {"method": "paper" if spec.method in RIVALS else spec.method},
        "source": {"min_rate_hz": min(2.0, 0.4 * spec.frame_rate_hz)},
        "camera": {"hfov_deg": spec.hfov_deg},
        "link": {"autopilot": "udpout:{}:{}".format(*autopilot)},
        "log": {"status_interval_s": 0.0, "detections": True},
    }
    for name, table in spec.settings.items():
        tables.setdefault(name, {}).update(table)
    return tables


def camera_model_of(spec: FlightSpec) -> CameraModel:
    """Return the camera's size and lens."""
    return CameraModel.from_hfov(spec.width_px, spec.height_px, spec.hfov_deg)


def camera_of(spec: FlightSpec, place: Place) -> Callable[[], SensorCamera]:
    """Return what makes the camera's view of a place; picklable, because the camera may be another process."""
    return partial(_sensor_camera, place.renderer, spec.image, spec.seed, 1.0 / spec.frame_rate_hz)


def _sensor_camera(
    renderer: Callable[[], Renderer], effects: ImageEffects, seed: int, frame_period_s: float
) -> SensorCamera:
    made = renderer()
    if not isinstance(made, PandaCamera):  # one whose samples cannot be chosen: no motion blur
        effects = dataclasses.replace(effects, exposure_s=0.0)
    return SensorCamera(
        cast("SampledRenderer", made), effects=effects, seed=seed, frame_period_s=frame_period_s
    )


def goal_of(place: Place) -> Waypoint:
    """Return where the planner is to go."""
    return Waypoint(*place.goal_ned_m)


def above_start(place: Place) -> Waypoint:
    """Return where the planner climbs to first."""
    return Waypoint(*place.start_ned_m)


async def take_off(planner: Planner, autopilot: FakeAutopilot, place: Place, clock: Clock) -> None:
    """Arm, enter OFFBOARD and climb.

    Raises
    ------
    FlightError
        When the vehicle does not get there.
    companion.sim.planner.PlannerError
        When the autopilot refuses or does not answer.
    """
    await planner.wait_ready()
    planner.aim(above_start(place))
    await planner.arm()
    await planner.start_offboard()
    await wait_for_height(autopilot, place, clock)


async def wait_for_height(
    autopilot: FakeAutopilot, place: Place, clock: Clock, *, within_s: float = _TAKE_OFF_S
) -> None:
    """Return when the vehicle is at the height of the flight.

    Raises
    ------
    FlightError
        When it does not get there.
    """
    end_ns = clock.now_ns() + round(1e9 * within_s)
    while abs(autopilot.true_state.position_ned_m[2] - place.start_ned_m[2]) > _AT_HEIGHT_M:
        if clock.now_ns() >= end_ns:
            raise FlightError(f"{place.name}: the vehicle did not take off within {within_s:g} s")
        await clock.sleep_until_ns(clock.now_ns() + _SAMPLE_NS)


async def watch(
    spec: FlightSpec,
    place: Place,
    autopilot: FakeAutopilot,
    recorder: FlightRecorder,
    planned: Callable[[], Waypoint | None],
    clock: Clock,
) -> Outcome:
    """Sample the flight, twenty times a second, until it has an outcome."""
    referee = Referee(place.goal_ned_m, spec.rules_for(place))
    begin_ns = clock.now_ns()
    recorder.begin(begin_ns)
    due_ns = begin_ns
    while True:
        now_ns = clock.now_ns()
        pose = autopilot.true_pose()
        position = (pose.north_m, pose.east_m, pose.down_m)
        clearance_m = place.clearance_m(position)
        recorder.sample(
            pose,
            now_ns,
            clearance_m=clearance_m,
            planned=planned(),
            sent=next((s for s in reversed(autopilot.setpoints) if s.refusal is None), None),
        )
        outcome = referee.judge((now_ns - begin_ns) / 1e9, position, clearance_m)
        if outcome is not None:
            return outcome
        due_ns += _SAMPLE_NS
        await clock.sleep_until_ns(due_ns)
