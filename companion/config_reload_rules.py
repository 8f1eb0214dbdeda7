"""What a changed configuration may do while the service runs (pure).

Settings of the switch S, of the log and of the plots act at once. What the vision worker is built from needs a new worker,
which takes some seconds in which the vehicle holds. Everything else is open, bound or built at the start: a change of it
waits for the next start, and is announced with the reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from companion.config import Config
from companion.config_file import config_of, merged


class WhenChanged(Enum):
    """What it takes for a changed value to act."""

    AT_ONCE = "at once"
    NEW_WORKER = "new worker"
    RESTART = "restart"


_AT_ONCE_TABLES: Final = frozenset({"guidance"})
_AT_ONCE: Final = frozenset(
    {
        "detector.send_obstacle_distance",
        "ground_station.plot_rate_hz",
        "ground_station.set_parameters",
        "log.detections",
        "log.level",
        "log.setpoints",
        "source.min_rate_hz",
    }
)
_NEW_WORKER_TABLES: Final = frozenset({"detector"})
_RESTART: Final[Mapping[str, str]] = {
    "detector.vehicle_width_m": "the switch S remembers obstacles by it",
    "guidance.estimator_jump_m": "the poses kept are judged by it",
    "camera": "the worker and the switch S are built on it",
    "source": "the frame source is open",
    "link": "the links are open",
    "interception": "what flies is built at the start",
    "engagement": "who may engage does not change in flight",
    "ground_station": "our own component is built at the start",
    "log": "the log is open",
    "detector.restart_delay_max_s": "the delays begin with the first worker",
    "detector.restart_delay_s": "the delays begin with the first worker",
    "status": "the sockets are open",
    "reload": "the watch has begun",
    "web": "the page is being served",
    "recorder": "the recorder is built at the start",
}
_OTHER_REASON: Final = "it is read at the start"


@dataclass(frozen=True, slots=True)
class Changes:
    """What differs between two configurations.

    Attributes
    ----------
    at_once, new_worker
        New values by dotted key.
    refused
        Why not, by dotted key.
    """

    at_once: Mapping[str, Any]
    new_worker: Mapping[str, Any]
    refused: Mapping[str, str]

    @property
    def any(self) -> bool:
        """Whether anything differs."""
        return bool(self.at_once or self.new_worker or self.refused)


def when_changed(key: str) -> WhenChanged:
    """Return what it takes for a changed value of a dotted key to act."""
    section = key.partition(".")[0]
    if key in _AT_ONCE:
        return WhenChanged.AT_ONCE
    if key in _RESTART:
        return WhenChanged.RESTART
    if section in _AT_ONCE_TABLES:
        return WhenChanged.AT_ONCE
    if section in _NEW_WORKER_TABLES:
        return WhenChanged.NEW_WORKER
    return WhenChanged.RESTART


def changes_between(active: Config, new: Config) -> Changes:
    """Return what differs, sorted by what it takes."""
    found: dict[WhenChanged, dict[str, Any]] = {when: {} for when in WhenChanged}
    for section in type(new).model_fields:
        old_table, new_table = getattr(active, section), getattr(new, section)
        for name in type(new_table).model_fields:
            value = getattr(new_table, name)
            if value != getattr(old_table, name):
                key = f"{section}.{name}"
                found[when_changed(key)][key] = value
    return Changes(
        at_once=found[WhenChanged.AT_ONCE],
        new_worker=found[WhenChanged.NEW_WORKER],
        refused={key: reason_to_restart(key) for key in found[WhenChanged.RESTART]},
    )


def reason_to_restart(key: str) -> str:
    """Return why a dotted key acts only after a restart."""
    return _RESTART.get(key) or _RESTART.get(key.partition(".")[0], _OTHER_REASON)


def with_changes(active: Config, changes: Changes) -> Config:
    """Return the active configuration with what may change in flight, checked as a whole.

    Raises
    ------
    companion.errors.ConfigError
        When new values do not go with old ones that need a restart.
    """
    table: dict[str, Any] = active.model_dump(exclude_unset=True)
    for key, value in {**changes.at_once, **changes.new_worker}.items():
        section, _, name = key.partition(".")
        table = merged(table, {section: {name: value}})
    return config_of(table, name="with what needs a restart as it was")
