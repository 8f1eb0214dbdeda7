"""The deciding parts of the service, given what a recording holds in place of links, clock and worker."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, cast

import structlog
from pydantic import TypeAdapter
from structlog.typing import EventDict, WrappedLogger

from companion.config import Config
from companion.core import Core
from companion.errors import CompanionError
from companion.guidance.observation import DetectionReport
from companion.io.feed import Feed
from companion.io.messages import Kind, Message
from companion.log import Log
from companion.mavlink.endpoint import FrameReceiver, LinkCounters
from companion.mavlink.framing import Framer
from companion.mavlink.signing import Signatures, read_key
from companion.replay.decisions import Decision, sent_decisions, state_decision

_report: Final = TypeAdapter(DetectionReport)


def report_of(message: Message) -> DetectionReport:
    """Return the report that a recorded message holds."""
    fields = {name: value for name, value in message.fields.items() if name in _FIELDS}
    return _report.validate_python(fields, strict=False)


_FIELDS: Final = frozenset(DetectionReport.__dataclass_fields__)


class ReplayLink:
    """A link without a wire: what comes in is given to it, what goes out is kept (``mavlink.endpoint.Link``)."""

    def __init__(self, number: int, sent: list[tuple[int, bytes]]) -> None:
        self.on_frames: FrameReceiver | None = None
        self.counters = LinkCounters()
        self._number = number
        self._sent = sent

    def send(self, datagram: bytes) -> int:
        """Keep a datagram."""
        self._sent.append((self._number, datagram))
        return 1

    def receive(self, data: bytes) -> None:
        """Deal with whole frames that came in together."""
        frames = Framer().feed(data)
        if frames and self.on_frames is not None:
            self.on_frames(frames)


class _States(Feed):
    """Listens to the switch S."""

    def __init__(self) -> None:
        super().__init__()
        self.changes: list[Decision] = []

    def state(self, previous: str, state: str, reason: str, now_ns: int) -> None:
        """Keep a change."""
        self.changes.append(state_decision(previous, state, reason, now_ns))


class ReplayedCore:
    """The core at recorded times.

    Parameters
    ----------
    config
        That it decides by.
    began_ns
        When the service began.
    offset_ns
        Wall time less monotonic time, for the age of signatures.

    Raises
    ------
    companion.errors.CompanionError
        When it cannot be built, such as for a key that is not there.
    """

    def __init__(self, config: Config, began_ns: int, offset_ns: int = 0) -> None:
        self._now_ns = began_ns
        self._config = config
        self._sent: list[tuple[int, bytes]] = []
        self._states = _States()
        planner = [ReplayLink(number, self._sent) for number in range(len(config.link.planner_urls))]
        autopilot = [
            ReplayLink(len(planner) + number, self._sent) for number in range(len(config.link.autopilot_urls))
        ]
        self._links = (*planner, *autopilot)
        self.core = Core.build(
            config,
            planner,
            autopilot,
            now_ns=lambda: self._now_ns,
            began_ns=began_ns,
            signatures=self._signatures(offset_ns),
            apply=self._apply,
            feed=self._states,
            log=_silent_log(),
        )

    def _signatures(self, offset_ns: int) -> Signatures | None:
        link = self._config.link
        if not link.signing_key_file:
            return None
        key = read_key(link.signing_key_file)
        return Signatures(key, link_id=link.signing_link_id, unix_ns=lambda: self._now_ns + offset_ns)

    @property
    def state(self) -> str:
        """Of the switch S."""
        return str(self.core.flight.switch.state)

    def give(self, message: Message, report: DetectionReport | None = None) -> list[Decision]:
        """Give an input of the recording; return what was decided on it.

        Parameters
        ----------
        message
            MAVLink that came in, a loop that ran, or a report that came.
        report
            In place of the recorded one.
        """
        now_ns = self._now_ns = message.time_ns
        core, flight = self.core, self.core.flight
        match message.kind:
            case Kind.MAVLINK:
                number = message.fields["link"]
                if number >= len(self._links):
                    raise CompanionError(f"the recording has a link {number}, the configuration has not")
                self._links[number].receive(message.data)
            case Kind.DETECTION:
                flight.on_report(report_of(message) if report is None else report, now_ns)
            case Kind.LOOP:
                self._loop(message.fields, now_ns)
            case Kind.CONFIG:
                self._take_config(message.fields)
            case _:
                raise ValueError(f"{message.kind} is no input")
        decided = [
            decision
            for number, datagram in self._sent
            for decision in sent_decisions(number, datagram, core.identity.component_id)
        ]
        decided += self._states.changes
        self._sent.clear()
        self._states.changes.clear()
        return decided

    def _loop(self, fields: Mapping[str, Any], now_ns: int) -> None:
        core, flight = self.core, self.core.flight
        match fields["name"]:
            case "health":
                flight.set_fault("camera", fields["camera"], now_ns)
                flight.set_fault("worker", fields["worker"], now_ns)
                flight.check_links(now_ns)
                flight.announce()
            case "heartbeat":
                core.identity.heartbeat(flight.mav_state(now_ns))
            case "component":
                core.own.component.tick(now_ns)
            case "takeover":
                if core.takeover is not None:
                    core.takeover.tick(now_ns)

    def _take_config(self, fields: Mapping[str, Any]) -> None:
        config = Config.model_validate(fields["set"])
        if config != self._config:  # else a parameter that was set has brought it about here, too
            self.core.own.settings.take(config, config)

    def _apply(self, config: Config) -> None:
        self._config = config


def _silent_log() -> Log:
    return cast(
        "Log",
        structlog.wrap_logger(
            None,
            processors=[_drop],
            wrapper_class=structlog.make_filtering_bound_logger("critical"),
            context_class=dict,
        ).bind(),
    )


def _drop(logger: WrappedLogger, method: str, event: EventDict) -> EventDict:  # noqa: ARG001  structlog's signature
    raise structlog.DropEvent
