"""A flight in simulated time: everything on one event loop, but for the service's worker process."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import AsyncExitStack

from companion.recorder.in_process import InProcessRecorder
from companion.run_statistics import percentiles
from companion.sim.companion_process import Event
from companion.sim.companion_task import CompanionTask
from companion.sim.flight import RIVALS, FlightSpec, FlownFlight
from companion.sim.flight_loop import (
    Address,
    autopilot_of,
    camera_model_of,
    camera_of,
    goal_of,
    service_tables,
    take_off,
    watch,
)
from companion.sim.flight_place import Place
from companion.sim.flight_record import FlightRecorder
from companion.sim.lockstep import LockstepLoop, run_lockstep
from companion.sim.planner import Planner
from companion.sim.stepped_camera import SteppedCamera
from companion.vision.pipeline import VOID_PIPELINE

_WORKER_START_S = 1.0
"""Simulated: it starts in no time."""


def fly_in_lockstep(spec: FlightSpec, place: Place, recorder: InProcessRecorder | None = None) -> FlownFlight:
    """Fly in simulated time; the same specification and place give the same flight, bit for bit.

    Parameters
    ----------
    spec, place
        Who flies how, and where.
    recorder
        Records the service; it is closed by the caller.

    Raises
    ------
    companion.errors.CompanionError
        When the simulation itself failed.
    """
    return run_lockstep(lambda loop: _fly(loop, spec, place, recorder), frame_s=spec.detection_s)


async def _fly(
    loop: LockstepLoop, spec: FlightSpec, place: Place, in_process: InProcessRecorder | None
) -> FlownFlight:
    clock = loop.clock
    recorder = FlightRecorder()
    summary: Mapping[str, float | None] = percentiles(())
    async with AsyncExitStack() as stack:
        autopilot = await stack.enter_async_context(autopilot_of(spec, place, clock))
        service: CompanionTask | None = None
        address: Address = autopilot.address
        if spec.method != "off":
            camera = SteppedCamera(
                stack.enter_context(camera_of(spec, place)()),
                camera_model_of(spec),
                autopilot.true_pose,
                clock=clock,
                rate_hz=spec.frame_rate_hz,
                faults=spec.frame_faults,
            )

            def on_event(event: Event) -> None:
                recorder.on_event(event, clock.now_ns())

            service = await stack.enter_async_context(
                CompanionTask(
                    service_tables(spec, autopilot.address),
                    clock=clock,
                    open_frames=lambda: camera,
                    on_event=on_event,
                    feed=None if in_process is None else in_process.feed,
                    pipeline=f"companion.sim.rivals:{spec.method}"
                    if spec.method in RIVALS
                    else VOID_PIPELINE,
                )
            )
            if in_process is not None:
                recording = loop.create_task(in_process.run(clock), name="recorder")
                stack.callback(recording.cancel)
            await service.wait_for("worker_ready", _WORKER_START_S)
            address = service.links[0].local_address
        planner = await stack.enter_async_context(Planner(address, rate_hz=spec.planner_hz, clock=clock))

        def on_the_way() -> int:
            links = [link.counters for link in service.links] if service is not None else []
            sent = sum(c.sent_datagrams for c in links) + planner.datagrams_sent + autopilot.datagrams_sent
            received = sum(c.received_datagrams for c in links)
            return sent - received - planner.datagrams_received - autopilot.datagrams_received

        loop.count_datagrams(on_the_way)
        stack.callback(loop.count_datagrams, None)  # first to be called: what is closed receives nothing more
        began_s, began_ns = time.perf_counter(), clock.now_ns()
        await take_off(planner, autopilot, place, clock)
        planner.aim(goal_of(place))
        outcome = await watch(spec, place, autopilot, recorder, lambda: goal_of(place), clock)
        simulated_s = (clock.now_ns() - began_ns) / 1e9
        factor = simulated_s / (time.perf_counter() - began_s)
        record = recorder.record(autopilot.setpoints, {})
        if service is not None:
            loop.count_datagrams(None)
            await service.stop()
            summary = service.of("summary")[-1]["frame_to_setpoint_ms"]
    return FlownFlight(outcome, record, factor, summary)
