"""Downloads the vehicle's mission (pure: frames in, requests out).

https://mavlink.io/en/services/mission.html#download_mission
"""

from __future__ import annotations

import struct
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.mission_goal import MissionItem
from companion.mavlink.framing import RawFrame

MISSION_COUNT: Final = 44
MISSION_ITEM_INT: Final = 73
MESSAGE_IDS: Final = frozenset({MISSION_COUNT, MISSION_ITEM_INT})

_COUNT: Final = struct.Struct("<HBBB")
_ITEM: Final = struct.Struct("<4fiifHHBBBBBB")
_RETRY_NS: Final = 1_000_000_000
_MOST_RETRIES: Final = 5
_MOST_ITEMS: Final = 5000
"""More than any autopilot keeps: a count beyond it is an error of the link."""


class MissionDownload:
    """One download after another, each begun by `begin`."""

    def __init__(self) -> None:
        self._count: int | None = None
        self._items: dict[int, MissionItem] = {}
        self._asked_ns = 0
        self._retries = 0
        self._is_running = False

    def begin(self) -> None:
        """Download from the start; what has come so far is dropped."""
        self._count, self._items, self._retries, self._is_running = None, {}, 0, True
        self._asked_ns = -(1 << 62)

    def due(self, target_system: int, target_component: int, now_ns: int) -> mavlink.MAVLink_message | None:
        """Return what is to be asked for now: the next item, again where no answer came within a second."""
        if not self._is_running or now_ns - self._asked_ns < _RETRY_NS:
            return None
        if self._retries >= _MOST_RETRIES:
            self._is_running = False
            return None
        self._retries += 1
        self._asked_ns = now_ns
        if self._count is None:
            return mavlink.MAVLink_mission_request_list_message(target_system, target_component, 0)
        return mavlink.MAVLink_mission_request_int_message(
            target_system, target_component, len(self._items), 0
        )

    def take(self, frame: RawFrame, *, system_id: int, component_id: int) -> bool:
        """Take a frame of `MESSAGE_IDS`; return whether it was an answer to us."""
        if frame.message_id == MISSION_COUNT:
            count, system, component, kind = _COUNT.unpack(_padded(frame, _COUNT.size))
            if (system, component, kind) != (system_id, component_id, 0):
                return False
            if self._is_running and self._count is None and count <= _MOST_ITEMS:
                self._count = count
                self._next()
            return True
        values = _ITEM.unpack(_padded(frame, _ITEM.size))
        x, y, z, seq, command, system, component, mav_frame, _, _, kind = values[4:]
        if (system, component, kind) != (system_id, component_id, 0):
            return False
        if self._is_running and self._count is not None and seq == len(self._items):
            self._items[seq] = MissionItem(seq, mav_frame, command, x, y, z)
            self._next()
        return True

    def finished(self) -> dict[int, MissionItem] | None:
        """Return the mission once, when it is complete."""
        if not self._is_running or self._count is None or len(self._items) < self._count:
            return None
        self._is_running = False
        return self._items

    def _next(self) -> None:
        self._retries = 0
        self._asked_ns = -(1 << 62)


def _padded(frame: RawFrame, size: int) -> bytes:
    return frame.payload.ljust(size, b"\0")[:size]
