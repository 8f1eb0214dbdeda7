"""Listens: both sides' links, the autopilot's answers, the camera. The only part of the doctor with sockets."""

from __future__ import annotations

import asyncio
import struct
from collections import Counter
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.clock import Clock
from companion.config import Config
from companion.doctor.autopilot_facts import facts
from companion.doctor.findings import CameraFinding, Findings, LinkFinding
from companion.errors import CompanionError, LinkError
from companion.frames.open import open_source
from companion.host_status import Host
from companion.log import Log
from companion.mavlink import codec, telemetry
from companion.mavlink.component import FLAGS, FLAGS_AT, TIMESYNC, TIMESYNC_FIELDS
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.endpoints import make_side
from companion.mavlink.framing import RawFrame
from companion.mavlink.identity import Identity, MavState, is_autopilot
from companion.mavlink.network import Side
from companion.mavlink.signing import open_signatures
from companion.mavlink.streams import StreamRequests, needs, request
from companion.mavlink.telemetry import MAV_AUTOPILOT_PX4, Heartbeat
from companion.mavlink.timesync import ClockSync, TimeSync

_HEARTBEAT: Final = 0
PARAM_VALUE: Final = 22
AUTOPILOT_VERSION: Final = 148
_PARAM_VALUE: Final = struct.Struct("<fHH16sB")
_VERSION_AT: Final = 16
_VERSION: Final = struct.Struct("<I")
_INTEGER_TYPES: Final = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}
"""MAV_PARAM_TYPE of what PX4 puts byte by byte into PARAM_VALUE's float."""
_SETPOINTS: Final = frozenset(
    {codec.SET_POSITION_TARGET_LOCAL_NED, codec.SET_POSITION_TARGET_GLOBAL_INT, codec.SET_ATTITUDE_TARGET}
)
_TURN_NS: Final = 200_000_000


class Examination:
    """Takes what comes, and asks for what does not come by itself.

    Parameters
    ----------
    config
        What is needed.
    identity
        Our voice.
    """

    def __init__(self, config: Config, identity: Identity) -> None:
        self._config = config
        self._identity = identity
        self._counts: Counter[int] = Counter()
        self._counting_since_ns: int | None = None
        self._streams = StreamRequests()
        self._timesync = TimeSync()
        self._turns = 0
        self._heartbeats_ns: list[int] = []
        self.vehicle: Heartbeat | None = None
        self.autopilot_systems: set[int] = set()
        self.version: tuple[int, int, int] | None = None
        self.parameters: dict[str, float] = {}
        self.estimator_flags: int | None = None
        self.planners: dict[tuple[int, int], bool] = {}

    def from_planner(self, frames: list[RawFrame]) -> None:
        """Take what the planner's side says."""
        for frame in frames:
            sender = (frame.system_id, frame.component_id)
            self.planners[sender] = self.planners.get(sender, False) or frame.message_id in _SETPOINTS

    def from_autopilot(self, frames: list[RawFrame], now_ns: int) -> None:
        """Take what the autopilot's side says."""
        for frame in frames:
            if frame.message_id == _HEARTBEAT:
                self._heartbeat(frame)
            vehicle = self.vehicle
            if vehicle is None or (frame.system_id, frame.component_id) != (
                vehicle.system_id,
                vehicle.component_id,
            ):
                continue
            self._counts[frame.message_id] += 1
            if frame.message_id == _HEARTBEAT:
                self._heartbeats_ns.append(now_ns)
            self._streams.count(frame.message_id)
            self._answer(frame, now_ns)

    def ask(self, now_ns: int) -> None:
        """Say that we are there, and ask for what has not come; five times a second."""
        second = self._turns % 5 == 0
        self._turns += 1
        if second:
            self._identity.heartbeat(MavState.BOOT)
        vehicle = self.vehicle
        if vehicle is None:
            return
        self._identity.send(mavlink.MAVLink_timesync_message(0, self._timesync.ask(now_ns)))
        for message_id, interval_us in self._streams.due(
            needs(vehicle.autopilot, self._config.engagement), now_ns
        ):
            self._identity.send(request(vehicle, message_id, interval_us))
        if not second:
            return
        system, component = vehicle.system_id, vehicle.component_id
        if self.version is None:
            command = mavlink.MAV_CMD_REQUEST_MESSAGE
            self._identity.send(
                mavlink.MAVLink_command_long_message(
                    system, component, command, 0, AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0
                )
            )
        for fact in facts(vehicle.autopilot):
            if fact.name not in self.parameters:
                name = fact.name.encode("ascii")
                self._identity.send(mavlink.MAVLink_param_request_read_message(system, component, name, -1))

    def count_anew(self, now_ns: int) -> None:
        """Count rates from now on."""
        self._counts.clear()
        self._counting_since_ns = now_ns

    def rates_hz(self, now_ns: int) -> dict[int, float]:
        """Return the rates of the vehicle's messages since `count_anew`."""
        if self._counting_since_ns is None or now_ns <= self._counting_since_ns:
            return {}
        elapsed_s = (now_ns - self._counting_since_ns) / 1e9
        rates_hz = {message_id: count / elapsed_s for message_id, count in self._counts.items()}
        beats_ns = self._heartbeats_ns
        if len(beats_ns) > 1:  # too few in half of the time to be counted: their distances tell
            rates_hz[_HEARTBEAT] = 1e9 * (len(beats_ns) - 1) / max(1, beats_ns[-1] - beats_ns[0])
        return rates_hz

    def clock(self, now_ns: int) -> ClockSync | None:
        """Return what the autopilot's clock is against ours."""
        return self._timesync.best(now_ns)

    def _heartbeat(self, frame: RawFrame) -> None:
        heartbeat = telemetry.decode(frame)
        if not isinstance(heartbeat, Heartbeat) or not is_autopilot(heartbeat):
            return
        self.autopilot_systems.add(heartbeat.system_id)
        if self.vehicle is None or heartbeat.system_id == self.vehicle.system_id:
            self.vehicle = heartbeat
            self._identity.learn(heartbeat)

    def _answer(self, frame: RawFrame, now_ns: int) -> None:
        payload = frame.payload
        if frame.message_id == TIMESYNC:
            tc1, ts1 = TIMESYNC_FIELDS.unpack(
                payload.ljust(TIMESYNC_FIELDS.size, b"\0")[: TIMESYNC_FIELDS.size]
            )
            if self._timesync.is_ours(ts1):
                self._timesync.on_answer(tc1, ts1, now_ns)
        elif frame.message_id == AUTOPILOT_VERSION:
            (number,) = _VERSION.unpack_from(payload.ljust(_VERSION_AT + 4, b"\0"), _VERSION_AT)
            self.version = (number >> 24, number >> 16 & 0xFF, number >> 8 & 0xFF)
        elif frame.message_id in FLAGS_AT:
            at = FLAGS_AT[frame.message_id]
            self.estimator_flags = FLAGS.unpack_from(payload.ljust(at + 2, b"\0"), at)[0]
        elif frame.message_id == PARAM_VALUE and self.vehicle is not None:
            fields = payload.ljust(_PARAM_VALUE.size, b"\0")[: _PARAM_VALUE.size]
            _, _, _, name, kind = _PARAM_VALUE.unpack(fields)
            is_bytewise = self.vehicle.autopilot == MAV_AUTOPILOT_PX4
            value = parameter_value(fields[:4], kind, is_bytewise=is_bytewise)
            self.parameters[name.split(b"\0")[0].decode("ascii", "replace")] = value


def parameter_value(field: bytes, kind: int, *, is_bytewise: bool) -> float:
    """Return the number in PARAM_VALUE's float: PX4 puts integers there byte by byte, ArduPilot as numbers."""
    form = _INTEGER_TYPES.get(kind) if is_bytewise else None
    return float(struct.unpack_from(form or "<f", field)[0])


async def examine(
    config: Config, *, seconds: float, clock: Clock, log: Log, with_worker: bool = True
) -> Findings:
    """Listen for a while and return what was found; what cannot be opened is a finding too.

    Parameters
    ----------
    config
        Names links and camera.
    seconds
        For how long; rates are counted in the second half.
    clock, log
        As everywhere.
    with_worker
        Start a vision worker to see whether it takes the configuration.
    """
    try:
        signatures, signing_fault = open_signatures(config.link), ""
    except CompanionError as error:
        signatures, signing_fault = None, str(error)
    host = Host(Path())
    host.look()
    async with AsyncExitStack() as stack:
        planner, planner_states = await _opened(stack, config, "planner", clock)
        autopilot, autopilot_states = await _opened(stack, config, "autopilot", clock)
        identity = Identity(
            Side(planner),
            Side(autopilot),
            component_id=config.link.component_id,
            now_ns=clock.now_ns,
            signatures=signatures,
        )
        examination = Examination(config, identity)
        for link in planner:
            link.on_frames = examination.from_planner
        for link in autopilot:
            link.on_frames = lambda frames: examination.from_autopilot(frames, clock.now_ns())
        async with asyncio.TaskGroup() as group:
            camera = group.create_task(_camera(config, seconds, clock, log))
            worker = group.create_task(_worker_fault(config, clock, log, wanted=with_worker))
            await _converse(examination, seconds, clock)
            now_ns = clock.now_ns()
            rates_hz = examination.rates_hz(now_ns)
        links = [_link_finding(link, "open") for link in (*planner, *autopilot)]
        failed = [*planner_states, *autopilot_states]
        found, vehicle = camera.result(), examination.vehicle
        return Findings(
            links=tuple(failed + links),
            vehicle=vehicle,
            autopilot_systems=frozenset(examination.autopilot_systems),
            rates_hz=rates_hz,
            version=examination.version,
            parameters=examination.parameters,
            clock=examination.clock(now_ns),
            estimator_flags=examination.estimator_flags,
            planners=examination.planners,
            signing_fault=signing_fault,
            camera=CameraFinding(
                found.fault, found.rate_hz, found.width_px, found.height_px, worker.result()
            ),
            host=host.look(),
        )


async def _opened(
    stack: AsyncExitStack, config: Config, side: str, clock: Clock
) -> tuple[list[Endpoint], list[LinkFinding]]:
    """Open the links of one side; return those that are open, and what became of the others."""
    urls = config.link.planner_urls if side == "planner" else config.link.autopilot_urls
    opened: list[Endpoint] = []
    failed: list[LinkFinding] = []
    for link in make_side(side, urls, now_ns=clock.now_ns):
        try:
            await stack.enter_async_context(link)
            opened.append(link)
        except LinkError as error:
            reason = str(error).removeprefix(f"{link.name}: ")
            failed.append(LinkFinding(link.name.removeprefix("link."), link.url, reason))
    return opened, failed


def _link_finding(link: Endpoint, opened: str) -> LinkFinding:
    counters = link.counters
    return LinkFinding(
        name=link.name.removeprefix("link."),
        url=link.url,
        state=link.state if link.state != opened else "open",
        received_bytes=counters.received_bytes,
        frames=counters.framing.frames,
        crc_errors=counters.framing.crc_errors,
        garbage_bytes=counters.framing.garbage_bytes,
    )


async def _converse(examination: Examination, seconds: float, clock: Clock) -> None:
    began_ns = clock.now_ns()
    half_ns, end_ns = began_ns + int(0.5e9 * seconds), began_ns + int(1e9 * seconds)
    counting = False
    while (now_ns := clock.now_ns()) < end_ns:
        if not counting and now_ns >= half_ns:
            counting = True
            examination.count_anew(now_ns)
        examination.ask(now_ns)
        await clock.sleep_until_ns(min(end_ns, now_ns + _TURN_NS))


async def _camera(config: Config, seconds: float, clock: Clock, log: Log) -> CameraFinding:
    """Take frames for a while."""
    times_ns: list[int] = []
    size = (0, 0)
    try:
        async with asyncio.timeout(seconds), open_source(config.source, clock=clock, log=log) as source:
            async for frame in source.frames():
                times_ns.append(clock.now_ns())
                size = (frame.image.shape[1], frame.image.shape[0])
    except TimeoutError:
        pass  # the time is up: that is how listening to a camera ends
    except CompanionError as error:
        return CameraFinding(str(error))
    if not times_ns:
        return CameraFinding("no frames")
    elapsed_s = (times_ns[-1] - times_ns[0]) / 1e9
    rate_hz = (len(times_ns) - 1) / elapsed_s if elapsed_s > 0 else 0.0
    return CameraFinding("", rate_hz, *size)


async def _worker_fault(config: Config, clock: Clock, log: Log, *, wanted: bool) -> str | None:
    """Return why a vision worker does not take the configuration, "" where it does; None where not tried."""
    if not wanted:
        return None
    from companion.vision.supervisor import VisionSupervisor

    supervisor = VisionSupervisor(
        config.detector, config.camera, clock=clock, on_report=lambda _: None, log=log
    )
    try:
        await supervisor.validate()
    except CompanionError as error:
        return str(error)
    return ""
