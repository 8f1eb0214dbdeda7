"""One replay: a recording from front to back, and what came out otherwise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from companion.config import Config
from companion.errors import CompanionError
from companion.io.messages import Kind, Message
from companion.recorder.reading import RecordingFile
from companion.replay.decisions import Decision, differences, sent_decisions, state_decision
from companion.replay.detections import Detections, in_words, same_answer
from companion.replay.inputs import ReplayedCore, report_of

DetectionsFrom = Literal["recorded", "rerun"]
_NEEDED: Final = frozenset({"frame", "frame_memory", "detection", "mavlink", "loop", "config", "state"})
"""What a replay depends on; of the rest the newest are enough."""
_INPUTS: Final = frozenset({Kind.DETECTION, Kind.LOOP, Kind.CONFIG})


@dataclass(frozen=True, slots=True)
class Difference:
    """One thing that came out otherwise.

    Attributes
    ----------
    time_s
        Since the recording began.
    kind
        ``setpoint``, ``state``, ``command`` or ``detection``.
    recorded, now
        What was and what is, for people.
    """

    time_s: float
    kind: str
    recorded: str
    now: str

    def __str__(self) -> str:
        return f"{self.time_s:9.3f} s  {self.kind}: recorded {self.recorded}; now {self.now}"


@dataclass(slots=True)
class Summary:
    """What a replay found.

    Attributes
    ----------
    duration_s
        Of the recording.
    inputs, decisions
        How many of each kind.
    differences
        How many of each kind, after the replay had caught up.
    before_caught_up
        Differences while the replay did not know yet what the service knew: where a recording begins in flight.
    notes
        What to know about the comparison.
    """

    duration_s: float = 0.0
    inputs: Counter[str] = field(default_factory=Counter)
    decisions: Counter[str] = field(default_factory=Counter)
    differences: Counter[str] = field(default_factory=Counter)
    before_caught_up: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def is_same(self) -> bool:
        """Whether everything was decided, and seen, as it was."""
        return not self.differences and self.decisions.total() > 0

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "same": self.is_same,
            "duration_s": round(self.duration_s, 3),
            "inputs": dict(self.inputs),
            "decisions": dict(self.decisions),
            "differences": dict(self.differences),
            "before_caught_up": self.before_caught_up,
            "notes": self.notes,
        }


def replay(
    file: RecordingFile,
    *,
    config: Config | None = None,
    detections: DetectionsFrom = "recorded",
    tolerance: float = 0.0,
    on_difference: Callable[[Difference], None] = lambda _: None,
) -> Summary:
    """Run a recording through the present code.

    Parameters
    ----------
    file
        The recording.
    config
        In place of the recorded one, but for its links; None: the recorded one.
    detections
        The recorded answers of the detector, or its answers now on the recorded frames.
    tolerance
        Of numbers in setpoints (m, m/s, rad); 0: to the last bit. Above 0 answers of the detector are compared with tolerance too.
    on_difference
        Called with each difference.

    Raises
    ------
    companion.errors.CompanionError
        When it is no recording, or holds nothing that could be replayed.
    """
    return _Run(file, config, detections, tolerance, on_difference).run()


class _Run:
    def __init__(
        self,
        file: RecordingFile,
        config: Config | None,
        detections: DetectionsFrom,
        tolerance: float,
        on_difference: Callable[[Difference], None],
    ) -> None:
        self._file = file
        self._other_config = config
        self._mode = detections
        self._tolerance = tolerance
        self._on_difference = on_difference
        self._summary = Summary()
        self._core: ReplayedCore | None = None
        self._detector: Detections | None = None
        self._began_ns = self._last_ns = 0
        self._caught_up = False
        self._held_state = ""
        self._own_component = 0

    def run(self) -> Summary:
        summary = self._summary
        for message, recorded, beside in self._turns(self._file.messages(images=self._mode == "rerun")):
            self._turn(message, recorded)
            for other in beside:
                self._beside(other)
        if self._core is None or not summary.inputs.total():
            raise CompanionError(f"{self._file.path}: holds nothing that could be replayed")
        summary.duration_s = (self._last_ns - self._began_ns) / 1e9
        self._note()
        return summary

    def _turns(self, messages: Iterable[Message]) -> Iterator[tuple[Message, list[Decision], list[Message]]]:
        """Yield each input with what the recording holds behind it, up to the next one: what was decided on it, and the rest."""
        waiting: Message | None = None
        decided: list[Decision] = []
        beside: list[Message] = []
        for message in messages:
            if message.kind in _INPUTS or _is_incoming(message):
                if message.kind is Kind.CONFIG and waiting is not None and waiting.kind is Kind.MAVLINK:
                    continue  # a parameter that was set: the input behind it brings that about here, too
                if waiting is not None:
                    yield waiting, decided, beside
                waiting, decided, beside = message, [], []
            elif message.kind is Kind.MAVLINK:
                decided += sent_decisions(message.fields["link"], message.data, self._own_component)
            elif message.kind is Kind.STATE:
                change = message.fields
                if waiting is not None:
                    decided.append(
                        state_decision(change["previous"], change["state"], change["reason"], message.time_ns)
                    )
                self._held_state = str(change["state"])
            else:
                beside.append(message)
        if waiting is not None:
            yield waiting, decided, beside

    def _beside(self, message: Message) -> None:
        """Take what is no input of the decisions."""
        if message.kind is Kind.FRAME and self._detector is not None:
            self._detector.frame(message)
        elif message.kind is Kind.LOG and message.fields.get("name") == "worker_ready":
            if self._detector is not None:
                self._detector.begin_anew()
        elif message.kind is Kind.CONTROL and message.fields.get("name") == "dropped":
            counts = dict(message.fields.get("counts", {}))
            lost = ", ".join(f"{count} {kind}" for kind, count in counts.items() if kind in _NEEDED)
            if lost:
                by, since_s = message.fields.get("by"), self._since_s(message)
                self._summary.notes.append(f"incomplete: {by} had lost {lost} by {since_s:.1f} s")

    def _turn(self, message: Message, recorded: list[Decision]) -> None:
        summary = self._summary
        if self._core is None:
            if message.kind is Kind.CONFIG:
                self._begin(message)
            return
        self._last_ns = message.time_ns
        summary.inputs[message.kind] += 1
        report = None
        if message.kind is Kind.CONFIG and self._other_config is not None:
            return
        if message.kind is Kind.DETECTION and self._detector is not None:
            recorded_report = report_of(message)
            report = self._detector.again(recorded_report)
            summary.decisions["detection"] += report is not None
            if report is not None and not same_answer(
                recorded_report, report, tolerant=self._tolerance > 0.0
            ):
                self._differs(message, "detection", in_words(recorded_report), in_words(report))
        now = self._core.give(message, report)
        summary.decisions.update(decision.kind for decision in recorded)
        found = differences(recorded, now, self._tolerance)
        if not found and recorded and self._core.state == self._held_state:
            self._caught_up = True
        for before, after in found:
            kind = before.kind if before is not None else after.kind if after is not None else ""
            self._differs(
                message,
                kind,
                "nothing" if before is None else before.text,
                "nothing" if after is None else after.text,
            )

    def _begin(self, message: Message) -> None:
        recorded = Config.model_validate(message.fields["set"])
        defaults = _changed_defaults(recorded, message.fields["active"])
        if defaults:
            self._summary.notes.append(f"defaults have changed since: {', '.join(defaults)}")
        config = recorded
        if self._other_config is not None:
            config = self._other_config.model_copy(update={"link": recorded.link, "source": recorded.source})
        self._began_ns = self._last_ns = message.time_ns
        offset_ns = int(self._file.about.get("monotonic_to_wall_ns", "0"))
        self._core = ReplayedCore(config, message.time_ns, offset_ns)
        self._own_component = config.link.component_id
        if self._mode == "rerun":
            self._detector = Detections(config)
        about = self._file.about
        self._caught_up = about.get("begun_by") == "always" and about.get("number") == "1"
        if not self._caught_up:
            self._summary.notes.append("begins in flight: what was known before is not in it")

    def _differs(self, message: Message, kind: str, recorded: str, now: str) -> None:
        if not self._caught_up:
            self._summary.before_caught_up += 1
            return
        self._summary.differences[kind] += 1
        self._on_difference(Difference(self._since_s(message), kind, recorded, now))

    def _since_s(self, message: Message) -> float:
        return (message.time_ns - self._began_ns) / 1e9

    def _note(self) -> None:
        notes = self._summary.notes
        if self._file.damage is not None:
            notes.append(f"the file is {self._file.damage}")
        if self._detector is not None and self._detector.missing:
            notes.append(
                f"{self._detector.missing} answers are on frames that were not recorded: kept as they were"
            )
        if self._detector is not None and self._detector.lossy:
            notes.append(
                f"{self._detector.lossy} frames were recorded as JPEG: answers may differ by that alone"
            )


def _is_incoming(message: Message) -> bool:
    return message.kind is Kind.MAVLINK and message.fields["direction"] == "in"


def _changed_defaults(recorded: Config, active: dict[str, Any]) -> list[str]:
    """Return keys, with both values, that had another default when the recording was made."""
    now = recorded.model_dump(mode="json")
    return [
        f"{table}.{key} was {value}"
        for table, values in active.items()
        if isinstance(values, dict)
        for key, value in values.items()
        if table in now and key in now[table] and now[table][key] != value
    ]
