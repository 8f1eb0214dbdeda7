"""Takeover: the autopilot flies its own mission, and we fly where its way is not free (``guidance.takeover``).

Setpoints are sent from here and not by mavsdk: its Offboard plugin repeats the last one for as long as its process lives,
whatever has become of detector and program, and it cannot share our link, our identity and our signatures. Here every
setpoint is decided in the call that sends it, from inputs whose age is checked there: none outlives them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.clock import Clock
from companion.config import Config
from companion.guidance.dialect import Autopilot
from companion.guidance.geodesy import to_local
from companion.guidance.mission_goal import MissionGoal, Place
from companion.guidance.setpoint import LocalSetpoint, MavFrame, Rewrite
from companion.guidance.substitution import State
from companion.guidance.table import LOOK_AGAIN, NO_WAY_OUT
from companion.guidance.takeover import Ask, Facts, Flown, Phase, Takeover, Way
from companion.interception import Interception
from companion.log import Log
from companion.mavlink import codec, mission_download, streams
from companion.mavlink.framing import CURRENT_MODE, RawFrame
from companion.mavlink.identity import Identity, MavSeverity
from companion.mavlink.mission_download import MissionDownload
from companion.mavlink.proxy import OwnComponent
from companion.mavlink.streams import Need, StreamRequests
from companion.mavlink.telemetry import MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4, Heartbeat, is_offboard

_HEARTBEAT: Final = 0
_GLOBAL_POSITION_INT: Final = 33
_MISSION_CURRENT: Final = 42
_MISSION_CLEAR_ALL: Final = 45
_POSITION_TARGET_GLOBAL_INT: Final = 87
_READ: Final = frozenset(
    {_HEARTBEAT, _GLOBAL_POSITION_INT, _MISSION_CURRENT, _POSITION_TARGET_GLOBAL_INT, CURRENT_MODE}
)
_SETPOINTS: Final = frozenset({codec.SET_POSITION_TARGET_LOCAL_NED, codec.SET_POSITION_TARGET_GLOBAL_INT})
_UPLOADS: Final = frozenset({mission_download.MISSION_COUNT, _MISSION_CLEAR_ALL})
_NEEDS: Final = (
    Need("CURRENT_MODE", (CURRENT_MODE,), 5.0, 10.0, False, "the pilot's change of mode, at once"),
    Need("MISSION_CURRENT", (_MISSION_CURRENT,), 0.5, 2.0, False, "the goal of the mission"),
    Need(
        "POSITION_TARGET_GLOBAL_INT",
        (_POSITION_TARGET_GLOBAL_INT,),
        1.0,
        5.0,
        False,
        "the goal of the mission",
    ),
    Need("GLOBAL_POSITION_INT", (_GLOBAL_POSITION_INT,), 1.0, 5.0, True, "where the mission lies"),
)
_HEARTBEAT_FIELDS: Final = struct.Struct("<IBBBBB")
_POSITION: Final = struct.Struct("<Iiiii")
_SEQ: Final = struct.Struct("<H")
_TARGET: Final = struct.Struct("<Iii9fHB")
_U32: Final = struct.Struct("<I")
_ABSOLUTE_FRAMES: Final = (MavFrame.GLOBAL, MavFrame.GLOBAL_INT)
_RELATIVE_FRAMES: Final = (MavFrame.GLOBAL_RELATIVE_ALT, MavFrame.GLOBAL_RELATIVE_ALT_INT)
_POSITION_ONLY: Final = 3576
_POSITION_AND_YAW: Final = 2552
_PX4_MODES: Final = {Ask.SETPOINTS: (6, 0), Ask.MISSION: (4, 4)}
_COPTER_MODES: Final = {Ask.SETPOINTS: (4, 0), Ask.MISSION: (3, 0)}
_PX4_MISSION: Final = 4 << 16 | 4 << 24
_COPTER_AUTO: Final = 3
_ALONE: Final = (Phase.IDLE, Phase.OUT)
_UPLOAD_NS: Final = 3_000_000_000
"""An upload that passes through us is over by then, and the mission is downloaded anew."""


class TakeoverFlight:
    """Feeds the table of ``guidance.takeover``, and carries out what it says.

    It stands before our own component in the proxy (``mavlink.proxy.OwnComponent``), reads what the autopilot says of mode
    and mission, and keeps setpoints of others from the autopilot: it does not arbitrate between two senders.

    Parameters
    ----------
    config
        The whole configuration.
    flight
        Holds the switch S, which decides on every setpoint.
    identity
        As whom setpoints and requests are sent.
    log
        Takes the events.
    own
        Our own component, asked about all other frames.
    engaged
        Whether protection is wanted.
    """

    def __init__(
        self,
        config: Config,
        flight: Interception,
        identity: Identity,
        *,
        log: Log,
        own: OwnComponent,
        engaged: Callable[[], bool],
    ) -> None:
        self._config = config
        self._flight = flight
        self._identity = identity
        self._log = log
        self._own = own
        self._engaged = engaged
        self.message_ids = own.message_ids | _READ | mission_download.MESSAGE_IDS | _SETPOINTS | _UPLOADS
        self.table = Takeover(config.interception)
        self._goal = MissionGoal(config.interception)
        self._download = MissionDownload()
        self._download_at_ns: int | None = 0
        self._streams = StreamRequests()
        self._custom_mode: int | None = None
        self._datum: tuple[float, float] | None = None
        self._planner_announced = False

    # ------------------------------------------------------------------ from the proxy

    def takes(self, frame: RawFrame, *, from_autopilot: bool, now_ns: int) -> bool:
        """Take a frame; return whether it is not to be passed on."""
        if not from_autopilot and frame.message_id in _SETPOINTS:
            return self._refuse_planner()
        if not from_autopilot and frame.message_id in _UPLOADS:
            self._goal.forget()
            self._download_at_ns = now_ns + _UPLOAD_NS
        if from_autopilot and self._is_vehicles(frame):
            if frame.message_id in mission_download.MESSAGE_IDS:
                identity = self._identity
                return self._download.take(
                    frame, system_id=identity.system_id, component_id=identity.component_id
                )
            if frame.message_id in _READ:
                self._read(frame, now_ns)
        if frame.message_id not in self._own.message_ids:
            return False
        return self._own.takes(frame, from_autopilot=from_autopilot, now_ns=now_ns)

    def _is_vehicles(self, frame: RawFrame) -> bool:
        vehicle = self._identity.vehicle
        return vehicle is not None and (frame.system_id, frame.component_id) == (
            vehicle.system_id,
            vehicle.component_id,
        )

    def _refuse_planner(self) -> bool:
        if not self._planner_announced:
            self._planner_announced = True
            self._log.warning("planner_refused", reason="interception.mode is takeover")
            self._identity.status_text(MavSeverity.WARNING, "void: setpoints refused, takeover mode")
        return True

    def _read(self, frame: RawFrame, now_ns: int) -> None:
        payload = frame.payload.ljust(64, b"\0")
        self._streams.count(frame.message_id)
        match frame.message_id:
            case _ if frame.message_id == _HEARTBEAT:
                self._custom_mode = _HEARTBEAT_FIELDS.unpack_from(payload)[0]
            case _ if frame.message_id == CURRENT_MODE:
                self._custom_mode = _U32.unpack_from(payload)[0]
            case _ if frame.message_id == _MISSION_CURRENT:
                self._goal.on_current(_SEQ.unpack_from(payload)[0], now_ns)
            case _ if frame.message_id == _GLOBAL_POSITION_INT:
                self._on_altitude(*_POSITION.unpack_from(payload)[3:])
            case _ if frame.message_id == _POSITION_TARGET_GLOBAL_INT:
                values = _TARGET.unpack_from(payload)
                lat, lon, alt_m, mask, mav_frame = values[1], values[2], values[3], values[12], values[13]
                known = mav_frame in _ABSOLUTE_FRAMES or mav_frame in _RELATIVE_FRAMES
                if known and math.isfinite(alt_m) and not mask & 7 and (lat, lon) != (0, 0):
                    place = Place(lat, lon, alt_m, mav_frame in _RELATIVE_FRAMES)
                    self._goal.on_target(place, now_ns, in_mission=self._flown() is Flown.MISSION)

    def _on_altitude(self, alt_mm: int, relative_mm: int) -> None:
        """Learn which altitude local z = 0 has, while we do not fly: z0 must not waver with the estimate."""
        pose = self._flight.switch.pose
        if pose is not None and (self._datum is None or not self.table.streams):
            self._datum = (pose.down_m + alt_mm / 1e3, pose.down_m + relative_mm / 1e3)

    # ------------------------------------------------------------------ the loop

    async def run(self, clock: Clock) -> None:
        """Fly, or watch, for ever, at the rate of the stream."""
        period_ns = round(1e9 / self._config.interception.stream_rate_hz)
        while True:
            now_ns = clock.now_ns()
            self._flight.feed.loop("takeover", now_ns, {})
            self.tick(now_ns)
            await clock.sleep_until_ns(now_ns + period_ns)

    def tick(self, now_ns: int) -> None:
        """Decide, and send at most one setpoint and one request."""
        vehicle = self._identity.vehicle
        if vehicle is None:
            return
        self._ask_for_streams_and_mission(vehicle, now_ns)
        if self._flight.reference is None:
            self._datum = None  # the local frame is another one: heights are learned anew
        flight, table = self._flight, self.table
        goal = self._local_goal(now_ns)
        before = table.phase
        ask = table.step(self._facts(goal, now_ns), now_ns)
        flight.watch_mission(table.phase not in _ALONE, now_ns)
        if before is Phase.IDLE and table.phase is Phase.WATCHING:
            self._download_at_ns = now_ns
        self._announce()
        if table.phase not in _ALONE:
            self._setpoint(vehicle, goal, now_ns)
        if ask is not None:
            self._ask(vehicle, ask)

    def _setpoint(self, vehicle: Heartbeat, goal: tuple[float, float, float] | str, now_ns: int) -> None:
        """Ask the switch S about the goal, in the mission too; send what it says where we stream."""
        pose = self._flight.switch.pose
        if isinstance(goal, str):
            if pose is None or not self.table.streams:
                return
            goal = (pose.north_m, pose.east_m, pose.down_m)  # to stay here, until the table has let go
        wish = _setpoint_of(vehicle, goal, None, now_ns)
        identity = self._identity
        verdict = self._flight.treat(wish, identity.system_id, identity.component_id, now_ns)
        if self.table.streams and isinstance(verdict, Rewrite):
            sent = _setpoint_of(vehicle, (verdict.x, verdict.y, goal[2]), verdict.yaw, now_ns)
            fields = {name: getattr(sent, name) for name in LocalSetpoint.__slots__}
            identity.send_to_autopilot(mavlink.MAVLink_set_position_target_local_ned_message(**fields))

    def _facts(self, goal: tuple[float, float, float] | str, now_ns: int) -> Facts:
        flight, switch = self._flight, self._flight.switch
        fault = switch.not_ready(now_ns)
        if fault is None and isinstance(goal, str):
            fault = goal
        if fault is None and switch.reason.startswith("gave up"):
            fault = switch.reason
        pose = switch.pose
        arrived = (
            pose is not None
            and not isinstance(goal, str)
            and math.dist(goal[:2], (pose.north_m, pose.east_m)) <= self._config.guidance.arrive_radius_m
        )
        return Facts(flight.armed, self._engaged(), self._flown(), self._way(), arrived, fault)

    def _way(self) -> Way:
        switch = self._flight.switch
        match switch.state:
            case State.FOLLOW:
                return Way.FREE
            case State.STEER | State.TURN:
                return Way.BLOCKED
            case State.HOLD if switch.reason in (LOOK_AGAIN, NO_WAY_OUT):
                return Way.BLOCKED
        return Way.UNKNOWN

    def _flown(self) -> Flown:
        vehicle, mode = self._identity.vehicle, self._custom_mode
        if vehicle is None or mode is None:
            return Flown.OTHER
        if is_offboard(vehicle, mode):
            return Flown.SETPOINTS
        missions = {MAV_AUTOPILOT_PX4: _PX4_MISSION, MAV_AUTOPILOT_ARDUPILOTMEGA: _COPTER_AUTO}
        return Flown.MISSION if missions.get(vehicle.autopilot) == mode else Flown.OTHER

    def _local_goal(self, now_ns: int) -> tuple[float, float, float] | str:
        """Return the mission's goal in local NED, or why there is none."""
        vehicle, anchor, datum = self._identity.vehicle, self._flight.reference, self._datum
        place = self._goal.place(now_ns, in_mission=self._flown() is Flown.MISSION)
        if isinstance(place, str):
            return place
        if vehicle is None or anchor is None or datum is None:
            return "no global reference"
        autopilot = Autopilot.ARDUPILOT if vehicle.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA else Autopilot.PX4
        north_m, east_m = to_local(anchor, place.lat_int, place.lon_int, autopilot)
        return north_m, east_m, datum[place.relative] - place.alt_m

    # ------------------------------------------------------------------ to the autopilot

    def _ask_for_streams_and_mission(self, vehicle: Heartbeat, now_ns: int) -> None:
        for message_id, interval_us in self._streams.due(_NEEDS, now_ns):
            self._identity.send_to_autopilot(streams.request(vehicle, message_id, interval_us))
        if self._download_at_ns is not None and now_ns >= self._download_at_ns:
            self._download_at_ns = None
            self._download.begin()
        request = self._download.due(vehicle.system_id, vehicle.component_id, now_ns)
        if request is not None:
            self._identity.send_to_autopilot(request)
        items = self._download.finished()
        if items is not None:
            self._goal.on_items(items)
            self._log.info("mission_downloaded", items=len(items))

    def _ask(self, vehicle: Heartbeat, ask: Ask) -> None:
        self._log.info("mode_requested", mode=ask.value)
        if ask is Ask.HOLD:
            self._identity.request_hold()
            return
        modes = _PX4_MODES if vehicle.autopilot == MAV_AUTOPILOT_PX4 else _COPTER_MODES
        self._identity.send_to_autopilot(
            mavlink.MAVLink_command_long_message(
                vehicle.system_id,
                vehicle.component_id,
                mavlink.MAV_CMD_DO_SET_MODE,
                0,
                1,
                *modes[ask],
                *[0] * 4,
            )
        )

    def _announce(self) -> None:
        for event in self.table.drain_events():
            self._log.info(
                "takeover",
                previous=str(event.previous),
                phase=str(event.phase),
                reason=event.reason,
                time_ns=event.time_ns,
            )
            severity = MavSeverity.WARNING if event.phase is Phase.OUT else MavSeverity.INFO
            self._identity.status_text(severity, f"void: takeover {event.phase} {event.reason}")


def _setpoint_of(
    vehicle: Heartbeat, place: tuple[float, float, float], yaw_rad: float | None, now_ns: int
) -> LocalSetpoint:
    has_yaw = yaw_rad is not None
    return LocalSetpoint(
        time_boot_ms=now_ns // 1_000_000 & 0xFFFFFFFF,
        x=place[0],
        y=place[1],
        z=place[2],
        vx=0.0,
        vy=0.0,
        vz=0.0,
        afx=0.0,
        afy=0.0,
        afz=0.0,
        yaw=yaw_rad if yaw_rad is not None else 0.0,
        yaw_rate=0.0,
        type_mask=_POSITION_AND_YAW if has_yaw else _POSITION_ONLY,
        target_system=vehicle.system_id,
        target_component=vehicle.component_id,
        coordinate_frame=int(MavFrame.LOCAL_NED),
    )
