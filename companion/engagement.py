"""Carries out what was decided about engagement: tells the interception, the log and the ground station."""

from __future__ import annotations

from typing import Final, Protocol

from companion.config import EngagementConfig
from companion.guidance.engagement import Answer, Engagement, Inputs
from companion.log import Log
from companion.mavlink.identity import MavSeverity

_REFUSAL_AGAIN_NS: Final = 10_000_000_000
"""A switch that stays up where something is missing is refused five times a second: it is said this often."""


class Protected(Protocol):
    """What engagement acts on: ``companion.interception.Interception``."""

    def inputs(self, now_ns: int) -> Inputs:
        """Return what is known of everything that protection needs."""
        ...

    def set_off(self, off: str | None, now_ns: int) -> None:
        """Take why protection is not wanted; None: it is."""
        ...


class Speaker(Protocol):
    """Says something to the ground station: ``companion.mavlink.identity.Identity``."""

    def status_text(self, severity: MavSeverity, text: str) -> None:
        """Send a status text."""
        ...


class EngagementControl:
    """Takes requests to engage and to let go, from remote control and ground station.

    Parameters
    ----------
    config
        Who may decide.
    flight
        What is engaged.
    speaker
        Tells the ground station.
    log
        Takes the events.
    now_ns
        The time at the start.
    """

    def __init__(
        self, config: EngagementConfig, flight: Protected, *, speaker: Speaker, log: Log, now_ns: int
    ) -> None:
        self._engagement = Engagement(config)
        self._flight = flight
        self._speaker = speaker
        self._log = log
        self._refused: tuple[tuple[str, ...], int] = ((), -(1 << 62))
        flight.set_off(self._engagement.off, now_ns)

    @property
    def engaged(self) -> bool:
        """Whether setpoints are to be protected."""
        return self._engagement.off is None

    def command(self, on: bool, now_ns: int, source: str) -> Answer:
        """Take a request of a ground station; ``source`` says which, for people."""
        answer = self._engagement.command(on, self._flight.inputs(now_ns), source)
        self._carry_out(answer, on, now_ns, source)
        return answer

    def on_rc_channels(self, pulses_us: tuple[int, ...], now_ns: int) -> None:
        """Take one RC_CHANNELS: pulse widths in us, the first channel first."""
        answer = self._engagement.rc_channels(pulses_us, self._flight.inputs(now_ns))
        if answer is not None:
            self._carry_out(
                answer, not answer.engaged if not answer.accepted else answer.engaged, now_ns, "RC"
            )

    def _carry_out(self, answer: Answer, on: bool, now_ns: int, source: str) -> None:
        if not answer.accepted:
            if self._refused[0] == answer.why_not and now_ns - self._refused[1] < _REFUSAL_AGAIN_NS:
                return
            self._refused = (answer.why_not, now_ns)
            wish = "engage" if on else "let go"
            self._log.warning("engagement_refused", wanted=wish, by=source, why=list(answer.why_not))
            self._speaker.status_text(
                MavSeverity.WARNING, f"void: cannot {wish}: {'; '.join(answer.why_not)}"
            )
            return
        self._refused = ((), -(1 << 62))
        self._flight.set_off(self._engagement.off, now_ns)
        self._log.info("engagement", engaged=answer.engaged, by=source)
        text = "void: engaged" if answer.engaged else "void: NOT engaged, setpoints pass"
        self._speaker.status_text(
            MavSeverity.NOTICE if answer.engaged else MavSeverity.WARNING, f"{text} ({source})"
        )
