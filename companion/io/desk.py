"""The service's end of the sinks' requests: what they may ask for, and what it is told of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, Protocol

from companion.config_reload_rules import Changes
from companion.errors import CompanionError
from companion.io.feed import Feed
from companion.io.messages import Answer
from companion.io.supervisor import RequestHandler
from companion.mavlink.identity import MavSeverity

RECORD: Final = "record"
ARMED: Final = "armed"
"""Names of control messages: ``{"on": bool}`` each."""

Settings = Callable[[Mapping[str, Any]], Awaitable[Changes]]


class Speaker(Protocol):
    """Our voice: ``companion.mavlink.identity.Identity``."""

    def status_text(self, severity: MavSeverity, text: str) -> None:
        """Send a status text."""
        ...


class ServiceDesk:
    """Does what sinks ask for.

    Parameters
    ----------
    feed
        Tells the sinks.
    speaker
        Says to ground stations what a sink wants to have said.
    now_ns
        Monotonic time.
    has_recorder
        Whether there is a sink that records.
    apply_settings
        Takes settings in flight, by dotted key (``companion.reload.Reload.apply``); None: they hold for the whole run.
    """

    def __init__(
        self,
        feed: Feed,
        speaker: Speaker,
        *,
        now_ns: Callable[[], int],
        has_recorder: bool,
        apply_settings: Settings | None,
    ) -> None:
        self._feed = feed
        self._speaker = speaker
        self._now_ns = now_ns
        self._has_recorder = has_recorder
        self._apply_settings = apply_settings
        self._recorder: Mapping[str, Any] = {"recording": False}
        self._armed: bool | None = None

    @property
    def handlers(self) -> dict[str, RequestHandler]:
        """What sinks may ask for, by name."""
        return {
            "apply_settings": self._on_apply_settings,
            "record": self._on_record,
            "recorder_state": self._on_recorder_state,
            "announce": self._on_announce,
        }

    # ------------------------------------------------------------------ from the service

    def note_armed(self, armed: bool, now_ns: int) -> None:
        """Tell the sinks when the vehicle has been armed or disarmed."""
        if armed != self._armed:
            self._armed = armed
            self._feed.control(ARMED, {"on": armed}, now_ns, retain=True)

    def record(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Begin or end a recording (a command of the status socket); what came of it the status tells.

        Raises
        ------
        companion.errors.CompanionError
            Where there is no recorder, or the argument is wrong.
        """
        on = arguments.get("on")
        if not isinstance(on, bool):
            raise CompanionError('record: expected {"on": true} or {"on": false}')
        if not self._has_recorder:
            raise CompanionError('there is no recorder: recorder.start is "never"')
        self._feed.control(RECORD, {"on": on}, self._now_ns())
        return self._recorder

    def recorder_status(self, now_ns: int) -> Mapping[str, Any]:  # noqa: ARG002  a section of the status is asked with the time
        """Return what the recorder last said of itself, for the status."""
        return self._recorder

    # ------------------------------------------------------------------ from the sinks

    async def _on_apply_settings(self, fields: Mapping[str, Any]) -> Answer:
        values = fields.get("values")
        if not isinstance(values, dict) or not values:
            return Answer(accepted=False, reasons=("expected values by dotted key",))
        if self._apply_settings is None:
            return Answer(accepted=False, reasons=("settings hold for the whole run",))
        try:
            changes = await self._apply_settings(values)
        except CompanionError as error:
            return Answer(accepted=False, reasons=(str(error),))
        taken = {"at_once": dict(changes.at_once), "new_worker": dict(changes.new_worker)}
        if changes.refused:
            reasons = tuple(
                f"{key}: needs a restart, {reason}" for key, reason in sorted(changes.refused.items())
            )
            return Answer(accepted=False, reasons=reasons, fields={"refused": dict(changes.refused)})
        return Answer(accepted=True, fields=taken)

    async def _on_record(self, fields: Mapping[str, Any]) -> Answer:
        try:
            return Answer(accepted=True, fields=self.record(fields))
        except CompanionError as error:
            return Answer(accepted=False, reasons=(str(error),))

    async def _on_recorder_state(self, fields: Mapping[str, Any]) -> Answer:
        self._recorder = dict(fields)
        self._feed.control("recorder_state", fields, self._now_ns(), retain=True)
        return Answer(accepted=True)

    async def _on_announce(self, fields: Mapping[str, Any]) -> Answer:
        severity = MavSeverity.WARNING if fields.get("problem") else MavSeverity.INFO
        self._speaker.status_text(severity, f"void: {str(fields.get('text', ''))[:200]}")
        return Answer(accepted=True)
