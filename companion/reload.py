"""Reads the configuration again while the service runs: when asked (SIGHUP), and when a file of it has changed.

What may change in flight acts at once (``companion.config_reload_rules``); the rest is announced with the reason. A
configuration that cannot be used changes nothing: it is taken as a whole or not at all.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from companion.clock import Clock
from companion.config import Config, DetectorConfig
from companion.config_file import config_of, merged
from companion.config_reload_rules import Changes, changes_between, with_changes
from companion.config_sources import ConfigPlaces, load
from companion.errors import CompanionError, ConfigError
from companion.log import LevelGate, Log
from companion.mavlink.identity import MavSeverity
from companion.settings import Settings
from companion.systemd import ServiceNotifier
from companion.vision.supervisor import VisionSupervisor

_MOST_READINGS: Final = 5
"""A ground station that changes a setting while files are read makes them be read again; so often at the most."""

Signature = tuple[tuple[str, int, int, int], ...]
"""Files with their inode, size and time of change."""


class Reload:
    """Takes a changed configuration in flight.

    Parameters
    ----------
    places
        Where it is read from.
    config
        As it was read at the start.
    settings
        The settings in force, and who they are applied by.
    vision
        The worker, which is replaced where its settings change.
    notifier
        systemd is told that a reload runs and when it is over.
    say
        Sends a STATUSTEXT.
    gate
        Takes the level of the log; None: it stays.
    clock
        Where time comes from.
    log
        Takes ``config_reloaded``, ``config_needs_restart``, ``config_rejected`` and ``config_reload_failed``.
    """

    def __init__(
        self,
        places: ConfigPlaces,
        config: Config,
        *,
        settings: Settings,
        vision: VisionSupervisor,
        notifier: ServiceNotifier,
        say: Callable[[MavSeverity, str], None],
        gate: LevelGate | None,
        clock: Clock,
        log: Log,
    ) -> None:
        self._places = places
        self._watch_s = config.reload.watch_s
        self._settings = settings
        self._vision = vision
        self._notifier = notifier
        self._say = say
        self._gate = gate
        self._clock = clock
        self._log = log
        self._wanted = asyncio.Event()
        self._turn = asyncio.Lock()
        self._parameters = _digest(config.detector.params_file)
        self._seen = signature_of(places, config.detector.params_file, config.web.saved_file)

    def request(self) -> None:
        """Ask for the configuration to be read again; :meth:`run` does it."""
        self._wanted.set()

    async def apply(self, values: Mapping[str, Any]) -> Changes:
        """Take single settings in flight, all or none; no file keeps them, and the next reload reads the files again.

        Parameters
        ----------
        values
            By dotted key.

        Returns
        -------
        What was taken. Where some need a restart, these and why: then nothing was taken.

        Raises
        ------
        companion.errors.CompanionError
            When a value cannot be used, or a worker cannot be built from them; nothing was taken.
        """
        async with self._turn:
            settings = self._settings
            for _ in range(_MOST_READINGS):
                revision = settings.revision
                new = _with_values(settings.active, values)
                changes = changes_between(settings.active, new)
                if changes.refused:
                    return changes
                if changes.new_worker:
                    await self._try_worker(new.detector, new)
                if settings.revision != revision:
                    continue  # a ground station was faster
                settings.take(new, _with_values(settings.kept, values))
                if self._gate is not None:
                    self._gate.set_level(new.log.level)
                if changes.new_worker:
                    self._vision.replace(new.detector)
                self._announce(changes, is_new_worker=bool(changes.new_worker))
                return changes
        raise ConfigError("a ground station keeps changing settings meanwhile: try again")

    async def run(self) -> None:
        """Read the configuration again whenever that is asked for, for ever."""
        async with asyncio.TaskGroup() as group:
            if self._watch_s:
                group.create_task(self._watch(), name="reload-watch")
            while True:
                await self._wanted.wait()
                self._wanted.clear()
                await self._reload()

    async def _watch(self) -> None:
        """Ask for a reload when a file has changed and then stood still for one look: editors write in several steps."""
        acted_on = before = self._seen
        while True:
            await self._clock.sleep_until_ns(self._clock.now_ns() + round(self._watch_s * 1e9))
            now = await self._look()
            if now == before and now != acted_on:
                acted_on = now
                self.request()
            before = now

    async def _look(self) -> Signature:
        active = self._settings.active
        return await asyncio.to_thread(
            signature_of, self._places, active.detector.params_file, active.web.saved_file
        )

    async def _reload(self) -> None:
        """Take what may change; whatever is wrong with the rest, flying goes on with the old settings."""
        self._notifier.reloading(self._clock.now_ns())
        try:
            async with self._turn:
                await self._take()
        except CompanionError as error:
            self._log.error("config_rejected", error=str(error))
            self._say(MavSeverity.ERROR, f"void: settings not taken: {str(error).partition(chr(10))[0]}")
        except Exception as error:  # noqa: BLE001  a fault of ours in here must not end the process in flight
            self._log.exception("config_reload_failed")
            self._say(MavSeverity.ERROR, f"void: settings not taken: {error!r}")
        finally:
            self._notifier.reloaded()

    async def _take(self) -> None:
        settings = self._settings
        for _ in range(_MOST_READINGS):
            revision = settings.revision
            loaded = await asyncio.to_thread(load, self._places, unsaved=settings.unsaved)
            new = loaded.config
            parameters = await asyncio.to_thread(_digest, new.detector.params_file)
            changes = changes_between(settings.active, new)
            active = with_changes(settings.active, changes)
            is_new_worker = bool(changes.new_worker) or parameters != self._parameters
            if is_new_worker:
                await self._try_worker(active.detector, active)
            if settings.revision != revision:
                continue  # a ground station was faster
            self._parameters = parameters
            settings.take(active, new)
            if self._gate is not None:
                self._gate.set_level(active.log.level)
            if is_new_worker:
                self._vision.replace(active.detector)
            self._announce(changes, is_new_worker=is_new_worker)
            return
        raise ConfigError("a ground station keeps changing settings meanwhile: try again")

    async def _try_worker(self, detector: DetectorConfig, config: Config) -> None:
        """Have a worker of its own say whether it can be built from these settings; the flying one goes on meanwhile."""
        trial = VisionSupervisor(
            detector, config.camera, clock=self._clock, on_report=lambda _: None, log=self._log
        )
        await trial.validate()

    def _announce(self, changes: Changes, *, is_new_worker: bool) -> None:
        changed = {**changes.at_once, **changes.new_worker}
        self._log.info("config_reloaded", changed=changed, new_worker=is_new_worker)
        if changed or is_new_worker:
            self._say(MavSeverity.INFO, f"void: settings taken: {_few(sorted(changed) or ['params_file'])}")
        if changes.refused:
            self._log.warning("config_needs_restart", reasons=dict(changes.refused))
            self._say(MavSeverity.WARNING, f"void: need a restart: {_few(sorted(changes.refused))}")


def _with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """Return a configuration with single values changed, checked as a whole; raises ConfigError."""
    table: dict[str, Any] = config.model_dump(exclude_unset=True)
    for key, value in values.items():
        section, _, name = key.partition(".")
        if not name:
            raise ConfigError(f"{key}: expected TABLE.KEY")
        table = merged(table, {section: {name: value}})
    return config_of(table, name="settings that were asked for")


def signature_of(places: ConfigPlaces, *others: str) -> Signature:
    """Return what tells whether a file of the configuration, or another that it names, has changed; what is not there is left out."""
    paths = [Path(other) for other in others if other]
    if places.file is not None:
        paths.append(places.file)
    try:
        paths.extend(places.drop_ins())
    except ConfigError:  # a reload says so, when it is asked for
        return ()
    found = []
    for path in paths:
        try:
            about = path.stat()
        except (OSError, ValueError):
            continue
        found.append((str(path), about.st_ino, about.st_size, about.st_mtime_ns))
    return tuple(found)


def _digest(params_file: str) -> bytes | None:
    """Return what tells the content of the parameters' file; None where there is none, or it cannot be read."""
    path = Path(params_file)
    try:
        # Only a plain file: a device may never end. What is wrong with it, the worker that is tried with it says.
        return hashlib.sha256(path.read_bytes()).digest() if params_file and path.is_file() else None
    except (OSError, ValueError):
        return None


def _few(keys: list[str]) -> str:
    shown = ", ".join(key.partition(".")[2] or key for key in keys[:2])
    return shown if len(keys) <= 2 else f"{shown} and {len(keys) - 2} more"
