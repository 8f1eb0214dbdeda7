"""Which of the autopilot's messages are needed how often, and asking for those that do not come (pure).

ArduPilot sends nothing but HEARTBEAT until it is asked; PX4 sends what its link's mode says. A message that comes often
enough is never asked for: whoever set its rate had a reason.
https://mavlink.io/en/messages/common.html#MAV_CMD_SET_MESSAGE_INTERVAL
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.config import EngagementConfig
from companion.mavlink.framing import EKF_STATUS_REPORT
from companion.mavlink.telemetry import MAV_AUTOPILOT_ARDUPILOTMEGA, Heartbeat

ATTITUDE: Final = 30
ATTITUDE_QUATERNION: Final = 31
LOCAL_POSITION_NED: Final = 32
GLOBAL_POSITION_INT: Final = 33
RC_CHANNELS: Final = 65
ESTIMATOR_STATUS: Final = 230

_WINDOW_NS: Final = 3_000_000_000
_FIRST_PAUSE_NS: Final = 3_000_000_000
_LONGEST_PAUSE_NS: Final = 60_000_000_000


@dataclass(frozen=True, slots=True)
class Need:
    """A stream that is needed.

    Attributes
    ----------
    name
        Of the message, for people.
    message_ids
        Any of these will do; the first is asked for.
    least_hz
        Below this it is asked for.
    asked_hz
        What is asked for.
    vital
        Without it there is no protection.
    why
        What it is for.
    """

    name: str
    message_ids: tuple[int, ...]
    least_hz: float
    asked_hz: float
    vital: bool
    why: str


def needs(autopilot: int, engagement: EngagementConfig) -> tuple[Need, ...]:
    """Return what is needed of a kind of autopilot (MAV_AUTOPILOT)."""
    is_ardupilot = autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA
    estimator = EKF_STATUS_REPORT if is_ardupilot else ESTIMATOR_STATUS
    found = [
        Need("LOCAL_POSITION_NED", (LOCAL_POSITION_NED,), 10.0, 30.0, True, "where the vehicle is"),
        Need("ATTITUDE", (ATTITUDE, ATTITUDE_QUATERNION), 20.0, 50.0, True, "where the camera looks"),
        Need(
            "EKF_STATUS_REPORT" if is_ardupilot else "ESTIMATOR_STATUS",
            (estimator,),
            0.2,
            1.0,
            False,
            "whether the estimator is healthy",
        ),
    ]
    if is_ardupilot:
        found.append(
            Need(
                "GLOBAL_POSITION_INT",
                (GLOBAL_POSITION_INT,),
                0.5,
                5.0,
                False,
                "setpoints of latitude and longitude",
            )
        )
    if engagement.by == "rc":
        found.append(Need("RC_CHANNELS", (RC_CHANNELS,), 2.0, 5.0, True, "the switch that engages"))
    return tuple(found)


def request(vehicle: Heartbeat, message_id: int, interval_us: int) -> mavlink.MAVLink_message:
    """Return the command that asks an autopilot for a message at an interval."""
    return mavlink.MAVLink_command_long_message(
        vehicle.system_id,
        vehicle.component_id,
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
        0,
        message_id,
        interval_us,
        0,
        0,
        0,
        0,
        0,
    )


class StreamRequests:
    """Counts what comes and says what to ask for, at first every few seconds, later once a minute."""

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._since_ns: int | None = None
        self._pause_ns: dict[str, int] = {}
        self._asked_ns: dict[str, int] = {}

    def count(self, message_id: int) -> None:
        """Count one message of the autopilot."""
        self._counts[message_id] += 1

    def due(self, wanted: tuple[Need, ...], now_ns: int) -> tuple[tuple[int, int], ...]:
        """Return (message id, interval in us) of what is to be asked for now; call it at least once a second."""
        if self._since_ns is None:
            self._since_ns = now_ns
        elapsed_ns = now_ns - self._since_ns
        if elapsed_ns < _WINDOW_NS:
            return ()
        rates_hz = {message_id: count * 1e9 / elapsed_ns for message_id, count in self._counts.items()}
        self._counts.clear()
        self._since_ns = now_ns
        asked = []
        for need in wanted:
            rate_hz = sum(rates_hz.get(message_id, 0.0) for message_id in need.message_ids)
            if rate_hz >= need.least_hz:
                self._pause_ns.pop(need.name, None)
                self._asked_ns.pop(need.name, None)
                continue
            pause_ns = self._pause_ns.get(need.name, 0)
            if now_ns - self._asked_ns.get(need.name, -(1 << 62)) < pause_ns:
                continue
            self._asked_ns[need.name] = now_ns
            self._pause_ns[need.name] = min(_LONGEST_PAUSE_NS, max(_FIRST_PAUSE_NS, 2 * pause_ns))
            asked.append((need.message_ids[0], round(1e6 / need.asked_hz)))
        return tuple(asked)
