"""The settings in force while the service runs: changed by a ground station, applied at once, kept over a restart."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Final

from companion.config import Config
from companion.config_overlay import Value, write_overlay
from companion.errors import ConfigError
from companion.guidance.engagement import Answer
from companion.log import Log
from companion.tuning import SETTINGS, changed, number_of, value_of

ENGAGE: Final = "VOID_ENGAGE"
"""Not a setting of the file: whether setpoints are protected now."""


class Settings:
    """Implements ``mavlink.parameters.ParameterStore`` on the configuration.

    Parameters
    ----------
    config
        The configuration as it was read.
    apply
        Takes the configuration that is to act from now on.
    engaged
        Whether setpoints are protected.
    engage
        Takes a request to protect or to let go.
    is_armed
        Whether the vehicle is armed.
    log
        Takes the events.
    """

    def __init__(
        self,
        config: Config,
        *,
        apply: Callable[[Config], None],
        engaged: Callable[[], bool],
        engage: Callable[[bool, int, str], Answer],
        is_armed: Callable[[], bool],
        log: Log,
    ) -> None:
        self._active = config
        self._kept = config
        self._apply = apply
        self._engaged = engaged
        self._engage = engage
        self._is_armed = is_armed
        self._log = log
        self._unsaved: dict[str, Value] = {}
        self._writing: dict[str, Value] = {}
        self.revision = 0
        """Counts the changes made by a ground station: whoever reads the files meanwhile reads them again."""
        self._changed = asyncio.Event()
        self._by_name = {setting.name: setting for setting in SETTINGS}
        self._names = tuple(sorted([*self._by_name, ENGAGE]))

    @property
    def active(self) -> Config:
        """The configuration that acts."""
        return self._active

    @property
    def kept(self) -> Config:
        """The configuration that will act after a restart."""
        return self._kept

    @property
    def unsaved(self) -> dict[str, Value]:
        """Values by dotted key that may not be in the parameters' file yet."""
        return {**self._writing, **self._unsaved}

    def take(self, active: Config, kept: Config) -> None:
        """Take a configuration that was read again.

        Parameters
        ----------
        active
            What acts from now on: what may change in flight is new in it.
        kept
            What will act after a restart.
        """
        self._active, self._kept = active, kept
        self._apply(active)

    def names(self) -> tuple[str, ...]:
        """Return all names in alphabetical order."""
        return self._names

    def number(self, name: str) -> float:
        """Return a value; of what acts only after a restart, the one that will."""
        if name == ENGAGE:
            return float(self._engaged())
        return number_of(self._kept, self._by_name[name])

    def set_number(self, name: str, number: float, now_ns: int) -> str | None:
        """Change a value, apply it where it may change in flight, and keep it; return in words why not."""
        if name == ENGAGE:
            if number not in (0.0, 1.0):
                return f"{ENGAGE}: found {number:g}; allowed: 0 or 1"
            answer = self._engage(number == 1.0, now_ns, "parameter")
            return None if answer.accepted else "; ".join(answer.why_not)
        allowed = self._kept.ground_station.set_parameters
        if allowed == "never" or (allowed == "disarmed" and self._is_armed()):
            return f"{name}: not set, ground_station.set_parameters is {allowed}"
        setting = self._by_name[name]
        try:
            kept = changed(self._kept, setting, number)
            active = changed(self._active, setting, number) if setting.live else self._active
        except ConfigError as error:
            return str(error).partition("\n")[0]
        if number_of(kept, setting) == number_of(self._kept, setting):
            return None  # nothing new: ground stations repeat themselves
        self._kept = kept
        self.revision += 1
        self._unsaved[setting.key] = value_of(kept, setting)
        self._changed.set()
        self._log.info("setting_changed", key=setting.key, value=value_of(kept, setting), live=setting.live)
        if active is not self._active:
            self._active = active
            self._apply(active)
        return None

    async def keep(self, complain: Callable[[str], None]) -> None:
        """Write what was changed to the parameters' file, for ever; what cannot be written is said, once a failure.

        Parameters
        ----------
        complain
            Takes why changes are lost with the next restart.
        """
        failed = ""
        while True:
            await self._changed.wait()
            self._changed.clear()
            changes, self._unsaved = self._unsaved, {}
            self._writing = changes
            name = self._kept.ground_station.parameters_file
            try:
                if not name:
                    raise ConfigError("no configuration file: settings are lost with a restart")  # noqa: TRY301  said as the rest is
                await asyncio.to_thread(write_overlay, Path(name), changes)
                failed = ""
                self._log.info("settings_kept", file=name, keys=sorted(changes))
            except ConfigError as error:
                self._unsaved = {**changes, **self._unsaved}  # with the next change they are tried again
                if str(error) != failed:
                    failed = str(error)
                    self._log.error("settings_not_kept", error=failed)
                    complain(failed)
            self._writing = {}
