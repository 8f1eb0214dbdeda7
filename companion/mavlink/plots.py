"""What a ground station plots: NAMED_VALUE_FLOAT, DEBUG_VECT and ONBOARD_COMPUTER_STATUS, at intervals it can set (pure).

https://mavlink.io/en/messages/common.html#NAMED_VALUE_FLOAT, #DEBUG_VECT, #ONBOARD_COMPUTER_STATUS
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.host_status import HostStatus

NAMED_VALUE_FLOAT: Final = 251
DEBUG_VECT: Final = 250
ONBOARD_COMPUTER_STATUS: Final = 390
_NAME_BYTES: Final = 10
_UNKNOWN_U8: Final = 0xFF
_UNKNOWN_U32: Final = 0xFFFFFFFF
_UNKNOWN_I8: Final = 127
_UNKNOWN_I16: Final = 32767


class Intervals:
    """When each kind of message is due.

    Parameters
    ----------
    configured_us
        Interval of each by its message id; -1: not sent.
    """

    def __init__(self, configured_us: Mapping[int, int]) -> None:
        self._configured_us = dict(configured_us)
        self._asked_us: dict[int, int] = {}
        self._sent_ns: dict[int, int] = {}

    def configure(self, message_id: int, interval_us: int) -> None:
        """Take another configured interval; one that was asked for by command stays."""
        self._configured_us[message_id] = interval_us

    def interval_us(self, message_id: int) -> int | None:
        """Return the interval in force (-1: off), or None for a message that is not sent so."""
        if message_id not in self._configured_us:
            return None
        return self._asked_us.get(message_id, self._configured_us[message_id])

    def set_interval_us(self, message_id: int, interval_us: int) -> None:
        """Set an interval as SET_MESSAGE_INTERVAL has it: us, 0 the configured one, -1 off."""
        if interval_us == 0:
            self._asked_us.pop(message_id, None)
        else:
            self._asked_us[message_id] = max(-1, interval_us)

    def is_due(self, message_id: int, now_ns: int) -> bool:
        """Whether a message is to be sent now; says so once an interval."""
        interval_us = self.interval_us(message_id)
        if interval_us is None or interval_us < 0:
            return False
        sent_ns = self._sent_ns.get(message_id)
        if sent_ns is not None and now_ns - sent_ns < 1000 * interval_us:
            return False
        self._sent_ns[message_id] = now_ns
        return True


def interval_of(rate_hz: float) -> int:
    """Return the interval of a rate in us; -1 for 0."""
    return round(1e6 / rate_hz) if rate_hz > 0 else -1


def named_values(values: Mapping[str, float | None], now_ns: int) -> list[mavlink.MAVLink_message]:
    """Return a NAMED_VALUE_FLOAT for each value that is known; names of at most 10 characters."""
    time_ms = now_ns // 1_000_000 & 0xFFFFFFFF
    return [
        mavlink.MAVLink_named_value_float_message(time_ms, _name(name), value)
        for name, value in values.items()
        if value is not None and math.isfinite(value)
    ]


def debug_vect(name: str, xyz: tuple[float, float, float], now_ns: int) -> mavlink.MAVLink_message:
    """Return a DEBUG_VECT; the name is at most 10 characters."""
    return mavlink.MAVLink_debug_vect_message(_name(name), now_ns // 1000, *xyz)


def computer_status(host: HostStatus, now_ns: int) -> mavlink.MAVLink_message:
    """Return ONBOARD_COMPUTER_STATUS; what is not known is marked as the message has it."""
    load = _UNKNOWN_U8 if host.cpu_load is None else round(100 * host.cpu_load)
    temperature = _UNKNOWN_I8
    if host.cpu_temperature_deg_c is not None:
        temperature = max(-128, min(126, round(host.cpu_temperature_deg_c)))
    uptime_ms = 0 if host.uptime_s is None else int(1000 * host.uptime_s) & _UNKNOWN_U32
    disk_used = _UNKNOWN_U32 if host.disk_used_mib is None else host.disk_used_mib
    disk_total = _UNKNOWN_U32 if host.disk_total_mib is None else host.disk_total_mib
    return mavlink.MAVLink_onboard_computer_status_message(
        now_ns // 1000,
        uptime_ms,
        0,  # the mission computer
        [_UNKNOWN_U8] * 8,
        [load] + [_UNKNOWN_U8] * 9,
        [_UNKNOWN_U8] * 4,
        [_UNKNOWN_U8] * 10,
        _UNKNOWN_I8,
        [temperature] + [_UNKNOWN_I8] * 7,
        [_UNKNOWN_I16] * 4,
        _UNKNOWN_U32 if host.memory_used_mib is None else host.memory_used_mib,
        _UNKNOWN_U32 if host.memory_total_mib is None else host.memory_total_mib,
        [_UNKNOWN_U32] * 4,
        [disk_used] + [_UNKNOWN_U32] * 3,
        [disk_total] + [_UNKNOWN_U32] * 3,
        [_UNKNOWN_U32] * 6,
        [_UNKNOWN_U32] * 6,
        [_UNKNOWN_U32] * 6,
        [_UNKNOWN_U32] * 6,
        [_UNKNOWN_U32] * 6,
    )


def _name(name: str) -> bytes:
    data = name.encode("ascii")
    if len(data) > _NAME_BYTES:
        raise ValueError(f"expected a name of at most {_NAME_BYTES} characters, got {name!r}")
    return data
