"""Settings as the page changes them: applied in flight with undo, compared with the file, saved to it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from companion.config import Config
from companion.config_file import config_of, merged
from companion.errors import ConfigError
from companion.io.messages import Answer
from companion.web.form import KEPT_OUT_REASON, is_kept_out, settings_form
from companion.web.settings_file import OnDisk, SettingsFile

Apply = Callable[[Mapping[str, Any]], Awaitable[Answer]]
"""Asks the service to take values in flight."""

_MOST_UNDO: Final = 50
_NOT_RUNNING: Final = "there is no running service behind this page"


class SettingsDesk:
    """Shows and changes the settings.

    Parameters
    ----------
    config
        That acts now.
    file
        Compared with and saved to.
    apply
        Asks the service; None: there is none, and nothing can be applied.
    """

    def __init__(self, config: Config, file: SettingsFile, apply: Apply | None = None) -> None:
        self._active: dict[str, Any] = _plain(config)
        self._file = file
        self._apply = apply
        self._undo: list[dict[str, Any]] = []
        self._turn = asyncio.Lock()

    def take_config(self, tables: Mapping[str, Any]) -> None:
        """Take the configuration that acts from now on, by table."""
        self._active = {name: dict(table) for name, table in tables.items()}

    @property
    def active(self) -> Mapping[str, Any]:
        """The configuration that acts, by table."""
        return self._active

    async def form(self) -> dict[str, Any]:
        """Return every setting with what acts, what the file says, and what a change would take."""
        active = self._active
        fault = ""
        disk: OnDisk | None = None
        try:
            disk = await asyncio.to_thread(self._file.read)
        except ConfigError as error:
            fault = str(error)
        on_disk: dict[str, Any] = {} if disk is None else _plain(disk.config)
        sections = settings_form()
        for section in sections:
            for entry in section["keys"]:
                name, key = section["name"], entry["name"]
                entry["value"] = active.get(name, {}).get(key)
                if disk is not None:
                    entry["file"] = on_disk[name][key]
                    entry["origin"] = disk.origins.get(entry["key"], "")
                if entry["key"] == "source.url":
                    _hide_password(entry)
        return {
            "sections": sections,
            "file": None if self._file.path is None else str(self._file.path),
            "saves_to": None if self._file.target is None else str(self._file.target),
            "revision": "" if disk is None else disk.revision,
            "fault": fault,
            "live": self._apply is not None,
            "undo": [sorted(values) for values in self._undo],
        }

    async def apply(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Have values taken in flight, all or none.

        Returns
        -------
        ``accepted``; ``reasons`` why not; ``refused``, the reason by key; ``at_once`` and ``new_worker``, what was taken.
        """
        async with self._turn:
            before = {key: self._value(key) for key in values}
            answer = await self._ask(values)
            if answer["accepted"] and (answer["at_once"] or answer["new_worker"]):
                self._undo = [*self._undo[-_MOST_UNDO + 1 :], before]
                self._note(values)
        return answer

    async def undo(self) -> dict[str, Any]:
        """Take back the last change that was made here and is not undone yet; as `apply`, with ``undone``."""
        async with self._turn:
            if not self._undo:
                return _refusal("there is nothing to undo")
            before = self._undo[-1]
            answer = await self._ask(before)
            if answer["accepted"]:
                self._undo.pop()
                self._note(before)
                answer["undone"] = before
        return answer

    async def save(self, values: Mapping[str, Any], *, revision: str, only_look: bool) -> dict[str, Any]:
        """Write values into the file that is saved to.

        Returns
        -------
        ``accepted``; ``reasons`` why not; ``diff``; ``file``, which was written; ``overruled``: by key the place that is read
        later and wins.
        """
        kept_out = {key: KEPT_OUT_REASON for key in values if is_kept_out(key)}
        if kept_out:
            return {**_refusal(*(f"{key} {why}" for key, why in kept_out.items())), "refused": kept_out}
        async with self._turn:
            try:
                diff = await asyncio.to_thread(
                    self._file.save, dict(values), revision=revision, only_look=only_look
                )
                disk = await asyncio.to_thread(self._file.read)
            except ConfigError as error:
                return _refusal(*str(error).splitlines())
        own = str(self._file.target)
        overruled = {
            key: disk.origins[key]
            for key in values
            if disk.origins.get(key, own) not in (own, "") and not only_look
        }
        return {"accepted": True, "reasons": [], "diff": diff, "file": own, "overruled": overruled}

    async def _ask(self, values: Mapping[str, Any]) -> dict[str, Any]:
        if self._apply is None:
            return _refusal(_NOT_RUNNING)
        if not values:
            return _refusal("no setting is named")
        if kept_out := {key: KEPT_OUT_REASON for key in values if is_kept_out(key)}:
            return {**_refusal(), "refused": kept_out}
        if reasons := self._faults(values):
            return _refusal(*reasons)
        answer = await self._apply(values)
        fields = answer.fields
        return {
            "accepted": answer.accepted and not fields.get("refused"),
            "reasons": list(answer.reasons),
            "refused": dict(fields.get("refused", {})),
            "at_once": dict(fields.get("at_once", {})),
            "new_worker": dict(fields.get("new_worker", {})),
        }

    def _faults(self, values: Mapping[str, Any]) -> list[str]:
        """Return what is wrong with values, one line a fault, before the service is asked."""
        table: dict[str, Any] = dict(self._active)
        for key, value in values.items():
            section, _, name = key.partition(".")
            table = merged(table, {section: {name: value}})
        try:
            config_of(table, name="settings")
        except ConfigError as error:
            return [line.removeprefix("settings: ") for line in str(error).splitlines()]
        return []

    def _value(self, key: str) -> Any:
        section, _, name = key.partition(".")
        return self._active.get(section, {}).get(name)

    def _note(self, values: Mapping[str, Any]) -> None:
        """Show at once what was taken; the service's own word follows."""
        table: dict[str, Any] = dict(self._active)
        for key, value in values.items():
            section, _, name = key.partition(".")
            table = merged(table, {section: {name: value}})
        self._active = table


def _refusal(*reasons: str) -> dict[str, Any]:
    return {"accepted": False, "reasons": list(reasons), "refused": {}, "at_once": {}, "new_worker": {}}


def _plain(config: Config) -> dict[str, Any]:
    """Return a configuration as JSON has it."""
    tables: dict[str, Any] = json.loads(config.model_dump_json())
    return tables


def _hide_password(entry: dict[str, Any]) -> None:
    """Show an address with a password in it without, and let it be."""
    for place in ("value", "file"):
        text = entry.get(place)
        if isinstance(text, str) and "@" in text:
            scheme, slashes, rest = text.partition("//")
            entry[place] = f"{scheme}{slashes}***@{rest.rpartition('@')[2]}"
            entry["kept_out"] = True
