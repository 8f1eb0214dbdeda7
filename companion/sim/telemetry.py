"""What the fake autopilot sends by itself, and how often. Pure: a snapshot in, messages out.

Rates are those measured on PX4 v1.16.1's companion link. https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import common as mavlink

from companion.sim.vehicle import Target, Vector3, VehicleState

_METRES_PER_DEGREE = 111_319.5
_ORIGIN_LAT_DEG, _ORIGIN_LON_DEG = 47.397742, 8.545594
ORIGIN_ALT_M = 488.0
"""Altitude of the origin of local NED."""
_NAN = float("nan")

CURRENT_MODE = 436
_CURRENT_MODE_CRC_EXTRA = 193

_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class Mode(Protocol):
    """A flight mode as HEARTBEAT shows it."""

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        ...

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode of a disarmed vehicle in this mode."""
        ...


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything that telemetry tells, at one time.

    Attributes
    ----------
    time_boot_us
        Time since the autopilot started, µs.
    time_unix_us
        The autopilot's idea of the date, µs.
    vehicle
        The estimate: position and motion in local NED.
    mode, armed, landed
        The commander's state.
    target
        What the position controller flies, None on the ground.
    home_ned_m
        Where it was armed.
    reset_counter
        Jumps of the estimate so far, modulo 256.
    is_ardupilot
        Whose telemetry it is: ArduPilot's, else PX4's.
    mission_seq
        The mission item that is flown.
    waypoint_ned_m
        What POSITION_TARGET_GLOBAL_INT tells; None: it is not sent.
    """

    time_boot_us: int
    time_unix_us: int
    vehicle: VehicleState
    mode: Mode
    armed: bool
    landed: LandedState
    target: Target | None
    home_ned_m: Vector3
    reset_counter: int
    is_ardupilot: bool = False
    mission_seq: int = 0
    waypoint_ned_m: Vector3 | None = None

    @property
    def time_boot_ms(self) -> int:
        """Time since start as most messages carry it."""
        return self.time_boot_us // 1000 & 0xFFFFFFFF


def _heartbeat(s: Snapshot) -> Any:
    return mavlink.MAVLink_heartbeat_message(
        type=mavlink.MAV_TYPE_QUADROTOR,
        autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA if s.is_ardupilot else mavlink.MAV_AUTOPILOT_PX4,
        base_mode=s.mode.base_mode | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if s.armed else 0),
        custom_mode=s.mode.custom_mode,
        system_status=_system_status(s),
        mavlink_version=3,
    )


def _system_status(s: Snapshot) -> int:
    """PX4 is active when armed, ArduPilot when it flies."""
    active = s.landed is not LandedState.ON_GROUND if s.is_ardupilot else s.armed
    return int(mavlink.MAV_STATE_ACTIVE if active else mavlink.MAV_STATE_STANDBY)


class _CurrentModeMessage:
    """CURRENT_MODE, which pymavlink 2.4.50's dialect lacks; packs itself as one of its messages does."""

    def __init__(self, custom_mode: int) -> None:
        self._payload = struct.pack("<IIB", custom_mode, custom_mode, 0).rstrip(b"\0") or b"\0"

    def get_type(self) -> str:
        """Return the message's name."""
        return "CURRENT_MODE"

    def pack(self, encoder: Any) -> bytes:
        """Return the frame with the encoder's sequence number and sender."""
        header = [len(self._payload), 0, 0, encoder.seq, encoder.srcSystem, encoder.srcComponent]
        covered = bytes(header) + CURRENT_MODE.to_bytes(3, "little") + self._payload
        crc = mavlink.x25crc(covered + bytes([_CURRENT_MODE_CRC_EXTRA])).crc
        return bytes([mavlink.PROTOCOL_MARKER_V2]) + covered + int(crc).to_bytes(2, "little")


def _current_mode(s: Snapshot) -> _CurrentModeMessage:
    return _CurrentModeMessage(s.mode.custom_mode)


def _attitude(s: Snapshot) -> Any:
    v = s.vehicle
    return mavlink.MAVLink_attitude_message(
        s.time_boot_ms, v.roll_rad, v.pitch_rad, v.yaw_rad, *v.body_rates_rad_s
    )


def _attitude_quaternion(s: Snapshot) -> Any:
    v = s.vehicle
    return mavlink.MAVLink_attitude_quaternion_message(
        s.time_boot_ms, *v.q_ned_from_body, *v.body_rates_rad_s
    )


def _local_position_ned(s: Snapshot) -> Any:
    v = s.vehicle
    return mavlink.MAVLink_local_position_ned_message(s.time_boot_ms, *v.position_ned_m, *v.velocity_ned_m_s)


def _odometry(s: Snapshot) -> Any:
    v = s.vehicle
    unknown = [_NAN] * 21
    return mavlink.MAVLink_odometry_message(
        s.time_boot_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_LOCAL_NED,
        *v.position_ned_m,
        list(v.q_ned_from_body),
        *v.velocity_ned_m_s,
        *v.body_rates_rad_s,
        unknown,
        unknown,
        s.reset_counter,
        mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        100,
    )


def _position_target_local_ned(s: Snapshot) -> Any:
    target = s.target
    if target is None or s.landed is LandedState.ON_GROUND:
        # As PX4 on the ground: NaN, with the bits that say so.
        return mavlink.MAVLink_position_target_local_ned_message(
            s.time_boot_ms,
            mavlink.MAV_FRAME_LOCAL_NED,
            63,
            *([_NAN] * 6),
            0.0,
            0.0,
            100.0,
            s.vehicle.yaw_rad,
            0.0,
        )
    position = [_NAN if p is None else p for p in target.position_ned_m]
    if s.is_ardupilot:
        return _position_target_of_ardupilot(s, target)
    yaw = s.vehicle.yaw_rad if target.yaw_rad is None else target.yaw_rad
    yaw_rate = 0.0 if target.yaw_rate_rad_s is None else target.yaw_rate_rad_s
    return mavlink.MAVLink_position_target_local_ned_message(
        s.time_boot_ms,
        mavlink.MAV_FRAME_LOCAL_NED,
        0,
        *position,
        *target.velocity_ned_m_s,
        0.0,
        0.0,
        0.0,
        yaw,
        yaw_rate,
    )


def _position_target_of_ardupilot(s: Snapshot, target: Target) -> Any:
    """Return it as ArduCopter sends it: the position alone, or the velocity alone, as the setpoint was."""
    if any(p is None for p in target.position_ned_m):
        place, mask = [0.0, 0.0, 0.0], 3527
    else:
        place, mask = [p or 0.0 for p in target.position_ned_m], 3576
    velocity = target.velocity_ned_m_s if mask == 3527 else (0.0, 0.0, 0.0)
    return mavlink.MAVLink_position_target_local_ned_message(
        s.time_boot_ms, mavlink.MAV_FRAME_LOCAL_NED, mask, *place, *velocity, 0.0, 0.0, 0.0, 0.0, 0.0
    )


def _extended_sys_state(s: Snapshot) -> Any:
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, int(s.landed))


def _sys_status(_: Snapshot) -> Any:
    return mavlink.MAVLink_sys_status_message(
        _SENSORS, _SENSORS, _SENSORS, 200, 16200, -1, 100, 0, 0, 0, 0, 0, 0
    )


def _home_position(s: Snapshot) -> Any:
    lat, lon, alt_mm = global_of(s.home_ned_m)
    return mavlink.MAVLink_home_position_message(
        lat, lon, alt_mm, *s.home_ned_m, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, s.time_boot_us
    )


def _gps_global_origin(s: Snapshot) -> Any:
    lat, lon, alt_mm = global_of((0.0, 0.0, 0.0))
    return mavlink.MAVLink_gps_global_origin_message(lat, lon, alt_mm, s.time_boot_us)


def _global_position_int(s: Snapshot) -> Any:
    lat, lon, alt_mm = global_of(s.vehicle.position_ned_m)
    vx, vy, vz = (max(-32768, min(32767, round(100 * v))) for v in s.vehicle.velocity_ned_m_s)
    height_mm = round(1000 * (s.home_ned_m[2] - s.vehicle.position_ned_m[2]))
    return mavlink.MAVLink_global_position_int_message(
        s.time_boot_ms, lat, lon, alt_mm, height_mm, vx, vy, vz, _centidegrees(s.vehicle.yaw_rad)
    )


def _gps_raw_int(s: Snapshot) -> Any:
    lat, lon, alt_mm = global_of(s.vehicle.position_ned_m)
    north, east, _ = s.vehicle.velocity_ned_m_s
    speed_cm_s = min(65534, round(100 * math.hypot(north, east)))
    course = _centidegrees(math.atan2(east, north))
    return mavlink.MAVLink_gps_raw_int_message(
        s.time_boot_us, mavlink.GPS_FIX_TYPE_3D_FIX, lat, lon, alt_mm, 70, 110, speed_cm_s, course, 10
    )


def _altitude(s: Snapshot) -> Any:
    height_m = -s.vehicle.position_ned_m[2]
    above_home_m = s.home_ned_m[2] + height_m
    altitude_m = ORIGIN_ALT_M + height_m
    return mavlink.MAVLink_altitude_message(
        s.time_boot_us, altitude_m, altitude_m, height_m, above_home_m, _NAN, _NAN
    )


def _vfr_hud(s: Snapshot) -> Any:
    north, east, down = s.vehicle.velocity_ned_m_s
    heading_deg = _centidegrees(s.vehicle.yaw_rad) // 100
    return mavlink.MAVLink_vfr_hud_message(
        0.0, math.hypot(north, east), heading_deg, 0, ORIGIN_ALT_M - s.vehicle.position_ned_m[2], -down
    )


def _estimator_status(s: Snapshot) -> Any:
    return mavlink.MAVLink_estimator_status_message(
        s.time_boot_us, 1023, 0.02, 0.02, 0.02, 0.02, 0.02, _NAN, 0.3, 0.3
    )


def _ekf_status_report(_: Snapshot) -> Any:
    return ardupilotmega.MAVLink_ekf_status_report_message(831, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0)


def _battery_status(_: Snapshot) -> Any:
    cells = [16200] + [65535] * 9
    return mavlink.MAVLink_battery_status_message(0, 1, 1, 32767, cells, -1, -1, -1, 100)


def _system_time(s: Snapshot) -> Any:
    return mavlink.MAVLink_system_time_message(s.time_unix_us, s.time_boot_ms)


def _mission_current(s: Snapshot) -> Any:
    return mavlink.MAVLink_mission_current_message(s.mission_seq)


def _position_target_global_int(s: Snapshot) -> Any:
    """Return the waypoint, or None where nothing is sent: on the ground, and on PX4 in OFFBOARD."""
    if s.waypoint_ned_m is None or s.landed is LandedState.ON_GROUND:
        return None
    lat, lon, alt_mm = global_of(s.waypoint_ned_m)
    return mavlink.MAVLink_position_target_global_int_message(
        s.time_boot_ms,
        mavlink.MAV_FRAME_GLOBAL_INT,
        3576 if s.is_ardupilot else 0,
        lat,
        lon,
        alt_mm / 1e3,
        *([0.0] * 8),
    )


def _autopilot_version(s: Snapshot) -> Any:
    encoding = (
        mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        if s.is_ardupilot
        else mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    )
    capabilities = (
        mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | encoding
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    )
    version = 4 << 24 | 7 << 16 if s.is_ardupilot else 1 << 24 | 16 << 16 | 1 << 8 | 255
    none = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        capabilities, version, 0, 0, 0, none, none, none, 0, 0, 1
    )


def global_of(position_ned_m: Vector3) -> tuple[int, int, int]:
    """Return latitude and longitude (1e-7 degrees) and altitude (mm) about a fixed origin."""
    north, east, down = position_ned_m
    lat_deg = _ORIGIN_LAT_DEG + north / _METRES_PER_DEGREE
    lon_deg = _ORIGIN_LON_DEG + east / (_METRES_PER_DEGREE * math.cos(math.radians(_ORIGIN_LAT_DEG)))
    return round(lat_deg * 1e7), round(lon_deg * 1e7), round((ORIGIN_ALT_M - down) * 1000)


def _centidegrees(azimuth_rad: float) -> int:
    return round(math.degrees(azimuth_rad) * 100) % 36000


@dataclass(frozen=True, slots=True)
class Stream:
    """One kind of message.

    Attributes
    ----------
    message_id
        MAVLink id.
    rate_hz
        Default rate; 0 is sent on request only.
    build
        Makes the message; None where there is nothing to send now.
    """

    message_id: int
    rate_hz: float
    build: Callable[[Snapshot], Any]


STREAMS: dict[int, Stream] = {
    stream.message_id: stream
    for stream in (
        Stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 1.0, _heartbeat),
        Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 100.0, _attitude),
        Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 50.0, _attitude_quaternion),
        Stream(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 30.0, _local_position_ned),
        Stream(mavlink.MAVLINK_MSG_ID_ODOMETRY, 30.0, _odometry),
        Stream(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 10.0, _position_target_local_ned),
        Stream(CURRENT_MODE, 0.5, _current_mode),
        Stream(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 5.0, _extended_sys_state),
        Stream(mavlink.MAVLINK_MSG_ID_SYS_STATUS, 5.0, _sys_status),
        Stream(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 50.0, _global_position_int),
        Stream(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 8.0, _gps_raw_int),
        Stream(mavlink.MAVLINK_MSG_ID_ALTITUDE, 10.0, _altitude),
        Stream(mavlink.MAVLINK_MSG_ID_VFR_HUD, 10.0, _vfr_hud),
        Stream(mavlink.MAVLINK_MSG_ID_HOME_POSITION, 0.5, _home_position),
        Stream(mavlink.MAVLINK_MSG_ID_BATTERY_STATUS, 0.5, _battery_status),
        Stream(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1.0, _system_time),
        Stream(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, 1.0, _estimator_status),
        Stream(ardupilotmega.MAVLINK_MSG_ID_EKF_STATUS_REPORT, 0.0, _ekf_status_report),
        Stream(mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, 1.0, _mission_current),
        Stream(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT, 9.9, _position_target_global_int),
        Stream(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 0.0, _gps_global_origin),
        Stream(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0.0, _autopilot_version),
    )
}


HEARTBEAT_ALONE = frozenset({int(mavlink.MAVLINK_MSG_ID_HEARTBEAT)})
"""What ArduPilot sends by itself."""


class StreamSchedule:
    """Which messages are due; SET_MESSAGE_INTERVAL acts here.

    Parameters
    ----------
    by_default
        Ids of those that are sent without being asked for; None: all that have a rate.
    """

    def __init__(self, by_default: frozenset[int] | None = None) -> None:
        self._by_default = by_default
        self._interval_us: dict[int, int] = {}
        self._due_us: dict[int, int] = {}
        for message_id in STREAMS:
            self.set_interval(message_id, 0)

    def interval_us(self, message_id: int) -> int | None:
        """Return the interval as MESSAGE_INTERVAL has it (-1: off), or None when the message is not known."""
        return self._interval_us.get(message_id)

    def set_interval(self, message_id: int, interval_us: float) -> bool:
        """Set an interval as SET_MESSAGE_INTERVAL has it: µs, 0 the default, -1 off. False when not possible."""
        if message_id not in STREAMS or not math.isfinite(interval_us):
            return False
        if interval_us == 0:
            is_default = self._by_default is None or message_id in self._by_default
            rate_hz = STREAMS[message_id].rate_hz if is_default else 0.0
            interval = round(1e6 / rate_hz) if rate_hz > 0 else -1
        else:
            interval = -1 if interval_us < 0 else min(max(1000, round(interval_us)), 2**31 - 1)
        self._interval_us[message_id] = interval
        self._due_us.pop(message_id, None)
        return True

    def due(self, time_boot_us: int) -> list[int]:
        """Return the ids to send now. One late by several intervals is sent once."""
        ids = []
        for message_id, interval in self._interval_us.items():
            if interval < 0:
                continue
            due_us = self._due_us.get(message_id, time_boot_us)
            if time_boot_us < due_us:
                continue
            ids.append(message_id)
            missed = (time_boot_us - due_us) // interval
            self._due_us[message_id] = due_us + (missed + 1) * interval
        return ids


def local_of(lat_int: int, lon_int: int) -> tuple[float, float]:
    """Return north and east (m) of a latitude and longitude (1e-7 degrees): the inverse of what telemetry tells."""
    north = (lat_int * 1e-7 - _ORIGIN_LAT_DEG) * _METRES_PER_DEGREE
    scale = _METRES_PER_DEGREE * math.cos(math.radians(_ORIGIN_LAT_DEG))
    return north, (lon_int * 1e-7 - _ORIGIN_LON_DEG) * scale
