"""When the companion flies in place of the autopilot's own mission: one table, no I/O, ``now_ns`` in.

==========  =================================  ================================================================
phase       sent                               goes to
==========  =================================  ================================================================
IDLE        nothing                            armed, engaged and in its mission -> WATCHING
WATCHING    nothing                            way blocked, goal known, no fault -> PREPARING; not in its mission
                                               any more -> IDLE
PREPARING   setpoints, which are not followed  streamed for ``stream_before_s`` and still blocked -> asks, once, for
            yet                                OFFBOARD or GUIDED: ASKING; free for half a second, fault or goal
                                               lost -> WATCHING
ASKING      setpoints                          in OFFBOARD or GUIDED -> FLYING; not after 2 s -> OUT
FLYING      setpoints                          way free for long enough, or arrived -> asks, once, for the mission:
                                               RETURNING; fault or goal lost for ``fault_s`` -> asks, once, for the
                                               autopilot's own hold: HOLDING
RETURNING   setpoints, until the mode is left  in its mission -> WATCHING; not after 2 s -> OUT
HOLDING     setpoints, until the mode is left  in another mode, or after 2 s -> OUT
OUT         nothing                            disarmed, or engaged anew -> IDLE
==========  =================================  ================================================================

From PREPARING on, a mode that we did not ask for ends our part (OUT): the pilot always wins, and nothing here asks for a
mode twice. Who lets go of protection (not engaged) while we fly gives the mission back. PX4 goes back into OFFBOARD by
itself when setpoints come again after a silence, so a mode is first left by asking for another, and then the stream ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum

from companion.config.takeover import InterceptionConfig

_CLEAR_NS = 500_000_000
"""Free for this long, nothing has to be taken over. Shorter is a flicker between two answers."""
_ANSWER_NS = 2_000_000_000
"""A mode that was asked for is there by then: HEARTBEAT says so once a second."""
_AGAIN_NS = 30_000_000_000
_MOST_DOUBLINGS = 3


class Phase(StrEnum):
    """Where the table stands."""

    IDLE = "IDLE"
    WATCHING = "WATCHING"
    PREPARING = "PREPARING"
    ASKING = "ASKING"
    FLYING = "FLYING"
    RETURNING = "RETURNING"
    HOLDING = "HOLDING"
    OUT = "OUT"


class Flown(Enum):
    """What flies the vehicle, from the autopilot's mode."""

    MISSION = "mission"
    SETPOINTS = "setpoints"
    OTHER = "other"


class Way(Enum):
    """What the switch S makes of the way to the mission's goal."""

    FREE = "free"
    BLOCKED = "blocked"
    UNKNOWN = "unknown"


class Ask(Enum):
    """A mode to ask the autopilot for, once."""

    SETPOINTS = "setpoints"
    MISSION = "mission"
    HOLD = "hold"


STREAMING = frozenset({Phase.PREPARING, Phase.ASKING, Phase.FLYING, Phase.RETURNING, Phase.HOLDING})
"""Phases in which setpoints of ours go out."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What is true now.

    Attributes
    ----------
    armed, engaged
        The vehicle is armed; protection is wanted.
    flown
        By what.
    way
        As the switch S sees it.
    arrived
        The vehicle is at the goal.
    fault
        The input that is missing or too old, the goal included; None: all are good.
    """

    armed: bool
    engaged: bool
    flown: Flown
    way: Way
    arrived: bool
    fault: str | None


@dataclass(frozen=True, slots=True)
class PhaseChanged:
    """The table went from one phase to another."""

    time_ns: int
    previous: Phase
    phase: Phase
    reason: str


class Takeover:
    """The table above.

    Parameters
    ----------
    config
        Its times.
    """

    def __init__(self, config: InterceptionConfig) -> None:
        self._config = config
        self._phase = Phase.IDLE
        self._reason = "start"
        self._since_ns = 0
        self._free_since_ns: int | None = None
        self._fault_since_ns: int | None = None
        self._was_engaged = False
        self._flew_ns: int | None = None
        self._doublings = 0
        self._events: list[PhaseChanged] = []

    @property
    def phase(self) -> Phase:
        """The present phase."""
        return self._phase

    @property
    def reason(self) -> str:
        """Why it is in that phase."""
        return self._reason

    @property
    def streams(self) -> bool:
        """Whether setpoints of ours go out."""
        return self._phase in STREAMING

    def drain_events(self) -> list[PhaseChanged]:
        """Return the changes since the last call, oldest first."""
        events, self._events = self._events, []
        return events

    def step(self, facts: Facts, now_ns: int) -> Ask | None:
        """Take what is true now; return a mode to ask for. Call it at the rate of the stream."""
        self._free_since_ns = (
            (self._free_since_ns if self._free_since_ns is not None else now_ns)
            if facts.way is Way.FREE
            else None
        )
        self._fault_since_ns = (
            (self._fault_since_ns if self._fault_since_ns is not None else now_ns) if facts.fault else None
        )
        engaged_anew = facts.engaged and not self._was_engaged
        self._was_engaged = facts.engaged
        if not facts.armed:
            self._doublings = 0
            self._to(Phase.IDLE, "disarmed", now_ns)
            return None
        match self._phase:
            case Phase.OUT:
                if engaged_anew:
                    self._to(Phase.IDLE, "engaged again", now_ns)
                return None
            case Phase.IDLE:
                if facts.engaged and facts.flown is Flown.MISSION:
                    self._to(Phase.WATCHING, "mission", now_ns)
                return None
            case Phase.WATCHING:
                self._watch(facts, now_ns)
                return None
            case Phase.PREPARING:
                return self._prepare(facts, now_ns)
            case Phase.ASKING:
                self._await(facts, now_ns, Flown.SETPOINTS, Flown.MISSION, Phase.FLYING, "taken over")
                return None
            case Phase.FLYING:
                return self._fly(facts, now_ns)
            case Phase.RETURNING:
                self._await(facts, now_ns, Flown.MISSION, Flown.SETPOINTS, Phase.WATCHING, "given back")
                return None
            case Phase.HOLDING:
                if facts.flown is not Flown.SETPOINTS:
                    self._to(Phase.OUT, "the autopilot holds", now_ns)
                    return None
                if now_ns - self._since_ns > _ANSWER_NS:
                    self._to(Phase.OUT, "hold was not taken", now_ns)
                    return None
        return None

    # ------------------------------------------------------------------ one row for each phase

    def _watch(self, facts: Facts, now_ns: int) -> None:
        if not facts.engaged:
            self._to(Phase.IDLE, "not engaged", now_ns)
        elif facts.flown is not Flown.MISSION:
            self._to(Phase.IDLE, "no mission", now_ns)
        elif facts.way is Way.BLOCKED and facts.fault is None:
            self._to(Phase.PREPARING, "way blocked", now_ns)

    def _prepare(self, facts: Facts, now_ns: int) -> Ask | None:
        if facts.flown is not Flown.MISSION:
            self._to(Phase.OUT, "the mode was changed", now_ns)
            return None
        if not facts.engaged or facts.fault is not None:
            self._to(Phase.WATCHING, facts.fault or "not engaged", now_ns)
            return None
        if self._free_for_ns(now_ns) >= _CLEAR_NS:
            self._to(Phase.WATCHING, "way free", now_ns)
            return None
        if facts.way is Way.BLOCKED and now_ns - self._since_ns >= self._config.stream_before_s * 1e9:
            self._to(Phase.ASKING, "way blocked", now_ns)
            return Ask.SETPOINTS
        return None

    def _fly(self, facts: Facts, now_ns: int) -> Ask | None:
        if facts.flown is not Flown.SETPOINTS:
            self._to(Phase.OUT, "the mode was changed", now_ns)
            return None
        if self._fault_since_ns is not None and now_ns - self._fault_since_ns >= self._config.fault_s * 1e9:
            self._to(Phase.HOLDING, facts.fault or "", now_ns)
            return Ask.HOLD
        needed_ns = self._config.give_back_s * 1e9 * 2**self._doublings
        free = self._free_for_ns(now_ns) >= needed_ns
        if not (free or facts.arrived or not facts.engaged) or facts.fault is not None:
            return None
        reason = "not engaged" if not facts.engaged else "at the goal" if facts.arrived else "way free"
        self._to(Phase.RETURNING, reason, now_ns)
        return Ask.MISSION

    def _await(
        self, facts: Facts, now_ns: int, wanted: Flown, before: Flown, then: Phase, reason: str
    ) -> None:
        if facts.flown is wanted:
            self._to(then, reason, now_ns)
        elif facts.flown is not before:
            self._to(Phase.OUT, "the mode was changed", now_ns)
        elif now_ns - self._since_ns > _ANSWER_NS:
            self._to(Phase.OUT, "the mode was not taken", now_ns)

    def _free_for_ns(self, now_ns: int) -> int:
        return -1 if self._free_since_ns is None else now_ns - max(self._free_since_ns, self._since_ns)

    def _to(self, phase: Phase, reason: str, now_ns: int) -> None:
        if phase is self._phase:
            return
        if phase is Phase.FLYING:
            again = self._flew_ns is not None and now_ns - self._flew_ns < _AGAIN_NS
            self._doublings = min(_MOST_DOUBLINGS, self._doublings + 1) if again else 0
        if self._phase is Phase.FLYING:
            self._flew_ns = now_ns
        self._events.append(PhaseChanged(now_ns, self._phase, phase, reason))
        self._phase, self._reason, self._since_ns = phase, reason, now_ns
