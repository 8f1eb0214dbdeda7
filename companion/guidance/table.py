"""The table of the switch S: what each state does next.

It looks at a situation and at the plan. Of the plan it changes what turns add up to: the sweep of a turn that is
done, and how far an alignment has come.

=============  =====================================================  ==========================================
state          sent in place of the planner's setpoint                goes to
=============  =====================================================  ==========================================
DISENGAGED     the planner's setpoint, untouched                      engaged: one of those below
FOLLOW         the planner's x, y, shortened to ``max_step_m`` and    wall: TURN; void elsewhere: STEER; goal out
               to the free distance; yaw at the bearing               of view: ALIGN; no good detection: HOLD
ALIGN          x, y held, yaw turns to the goal's bearing             in view: FOLLOW, STEER, TURN or HOLD
STEER          (x*, y*, z0) toward the void                           void agrees: FOLLOW; committed distance
                                                                      flown: ALIGN; wall: TURN; not good: HOLD
TURN           x, y held, yaw stepped to one side                     step done: PROBE; swept 360 deg: HOLD
PROBE          one short step along a bearing seen free, else back    answer: FOLLOW, STEER or TURN; no answer:
               along the track, else (once a heading) along the       TURN or HOLD
               camera's axis
HOLD           x, y, yaw held                                         good detection: what it asks for; no
                                                                      parallax: PROBE; for long: give up
=============  =====================================================  ==========================================
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from companion.config import GuidanceConfig
from companion.guidance.coordinates import wrap_rad
from companion.guidance.plan import TURN_DONE_RAD, Plan
from companion.guidance.situation import Answer, Evidence, Situation

LOOK_AGAIN = "way blocked, looking again"
"""One answer says that no way is open: no step is made, and the vote of the next answers decides."""
NOT_LOOKED_THROUGH = "way not looked through"
"""At rest, the camera towards the way: something could stand beside it that was never in view. A step back shows it."""
GAP_SEEN = "gap seen"
NO_WAY_OUT = "no way out"
TURNS_ALONG = "the goal turns with the vehicle"
"""A direction in the body frame that is out of view: turning toward it does not bring it into view."""
_GAP_VIEW_DEG = 75.0
"""A goal further off the axis than this is looked at before a gap is flown to."""
_MEASURED_FREE_FACTOR = 0.7
"""In FOLLOW this share of a step measured free is enough to stay: the step is shortened to it anyway."""
_SHORT_STEP_M = 0.5
_NEAR_M = 2.0
_REASON_KEPT_NS = 2_000_000_000
"""While nothing but the reason of HOLD changes, it is announced at most this often."""


class State(StrEnum):
    """The states of the switch S."""

    DISENGAGED = "DISENGAGED"
    FOLLOW = "FOLLOW"
    ALIGN = "ALIGN"
    STEER = "STEER"
    TURN = "TURN"
    PROBE = "PROBE"
    HOLD = "HOLD"


HELD_STATES = (State.ALIGN, State.TURN, State.HOLD)
"""States whose x, y stay at one anchor, which is kept when one of them follows another."""

Change = tuple[State, str]
"""A state and the reason for it."""


@dataclass(slots=True)
class Standing:
    """Where the switch stands: its state, why, and since when.

    Attributes
    ----------
    state, reason
        The present ones.
    entered_ns, reason_ns
        Since when.
    gave_up
        No way was found for long: HOLD stays until the goal is another one.
    """

    state: State = State.DISENGAGED
    reason: str = "start"
    entered_ns: int = 0
    reason_ns: int = 0
    gave_up: bool = False

    def for_s(self, now_ns: int) -> float:
        """Return for how long it has been in this state."""
        return (now_ns - self.entered_ns) / 1e9


class Table:
    """Says, for a situation, which state it asks for and when the present one is left.

    Parameters
    ----------
    config
        Limits and distances.
    evidence, plan, standing
        What is known, what is being done, and where the switch stands.
    """

    def __init__(self, config: GuidanceConfig, evidence: Evidence, plan: Plan, standing: Standing) -> None:
        self._config = config
        self._evidence = evidence
        self._plan = plan
        self._standing = standing
        self._rows: dict[State, Callable[[Situation], Change | None]] = {
            State.FOLLOW: self._from_follow,
            State.ALIGN: self._from_align,
            State.STEER: self._from_steer,
            State.TURN: self._from_turn,
            State.PROBE: self._from_probe,
            State.HOLD: self._from_hold,
        }

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take other limits from the next setpoint on."""
        self._config = config

    def change(self, s: Situation) -> Change | None:
        """Return the state that follows the present one and why, or None where it stays."""
        return self._rows[self._standing.state](s)

    def choose(self, s: Situation) -> Change:
        """Return the state that the situation asks for, whatever the present one."""
        state, reason = self._wanted(s)
        if s.reached or s.speed_m_s > self._config.moving_m_s or not self._waits_to_look(state, s):
            return state, reason
        return State.HOLD, NOT_LOOKED_THROUGH

    def _waits_to_look(self, state: State, s: Situation) -> bool:
        """Whether the way of a state is in sight and was not looked through for a step."""
        if state is State.FOLLOW:
            azimuth = s.bearing_rad
        elif state is State.STEER and (s.gap is not None or s.answer is not None):
            azimuth, _ = self._evidence.steered(s)
        else:
            return False
        in_sight = abs(wrap_rad(azimuth - s.look_rad)) <= math.radians(0.5 * self._config.align_deg)
        return in_sight and self._evidence.ways.reach_m(azimuth, s.pose) <= 0.0

    def _wanted(self, s: Situation) -> Change:
        if s.reached:
            return State.FOLLOW, "at the goal"
        in_view = s.off_axis_rad <= math.radians(self._config.view_deg)
        episode = self._plan.episode
        blocked_before = episode is not None and episode.is_blocked(s.bearing_rad)
        if s.gap is not None and (s.off_axis_rad <= math.radians(_GAP_VIEW_DEG) or blocked_before):
            return State.STEER, GAP_SEEN
        if s.wall is not None:
            return State.TURN, s.wall
        if in_view and self._is_measured_free(s):
            return State.FOLLOW, "way measured free"
        if s.answer is None:
            if in_view or blocked_before:
                return State.HOLD, s.no_answer
            return self._look_there(s)
        if not in_view and not blocked_before and not self._goes_on_better(s, s.answer):
            return self._look_there(s)
        evidence = self._evidence
        if in_view and evidence.is_open(s.free_bearing_m, s.goal_m) and self._agrees(s):
            return State.FOLLOW, "void agrees"
        void_is_open = evidence.is_open(evidence.void_free_m(s.answer, s), math.inf)
        if void_is_open and not (in_view and self._agrees(s)):
            return State.STEER, "void elsewhere"
        return State.HOLD, LOOK_AGAIN

    def _look_there(self, s: Situation) -> Change:
        if self._plan.turns_along(s.wish.body_bearing_rad):
            return State.HOLD, TURNS_ALONG
        return State.ALIGN, "goal out of view"

    def _goes_on_better(self, s: Situation, answer: Answer) -> bool:
        """Whether something is remembered near the goal's bearing, and the void leads further: no need to look there."""
        void_m = self._evidence.void_free_m(answer, s)
        return s.free_bearing_m is not None and void_m is not None and s.free_bearing_m < _NEAR_M <= void_m

    def _agrees(self, s: Situation) -> bool:
        """Whether the void lies at the goal's bearing, or a plane that fills the view is far enough."""
        if s.answer is None:
            return False
        if s.answer.is_plane:  # only asked while the bearing is in view, so it points at this plane
            return True
        limit_deg = self._config.agree_deg
        if self._standing.state is State.FOLLOW:
            limit_deg += self._config.agree_hysteresis_deg
        return abs(wrap_rad(s.answer.azimuth_rad - s.bearing_rad)) <= math.radians(limit_deg)

    def _is_measured_free(self, s: Situation) -> bool:
        """Whether the whole next step toward the goal is known to be free."""
        step_m = min(s.goal_m, self._config.max_step_m)
        if s.answer is None:  # ranges without a direction: a short step is as good as what is known
            if not self._evidence.sees_ranges():
                return False
            step_m = min(step_m, _SHORT_STEP_M)
        if self._standing.state is State.FOLLOW:
            step_m *= _MEASURED_FREE_FACTOR
        return (
            s.free_bearing_m is not None
            and s.free_bearing_m - self._config.step_margin_m >= step_m
            and self._evidence.seen.is_measured(s.bearing_rad, s.pose, s.speed_m_s, s.now_ns)
        )

    # ------------------------------------------------------------------ one row for each state

    def _from_follow(self, s: Situation) -> Change | None:
        state, reason = self.choose(s)
        return None if state is State.FOLLOW or self._looks_again(s, reason) else (state, reason)

    def _from_align(self, s: Situation) -> Change | None:
        if s.reached:
            return State.FOLLOW, "at the goal"
        if s.off_axis_rad <= 0.6 * math.radians(self._config.view_deg):
            return self.choose(s)
        in_vain = self._plan.aligned_in_vain(s.look_rad)
        if in_vain and s.wish.body_bearing_rad is not None:
            self._plan.turns_along_rad = s.wish.body_bearing_rad
            return State.HOLD, TURNS_ALONG
        turn_s = math.pi / math.radians(self._config.yaw_rate_deg_s)
        if self._standing.for_s(s.now_ns) > 2 * turn_s + 3:
            return State.HOLD, "the vehicle does not turn"
        return None

    def _from_steer(self, s: Situation) -> Change | None:
        state, reason = self.choose(s)
        if state is State.ALIGN and s.answer is not None:
            flown_m = math.dist(self._plan.steer_start, (s.pose.north_m, s.pose.east_m))
            if flown_m >= self._config.commit_distance_m:
                return State.ALIGN, "looking towards the goal again"
            # Without a way to go on along, there is nothing to be committed to.
            evidence = self._evidence
            goes_on = evidence.is_open(evidence.void_free_m(s.answer, s), math.inf)
            return None if goes_on else (state, reason)
        return None if state is State.STEER or self._looks_again(s, reason) else (state, reason)

    def _looks_again(self, s: Situation, reason: str) -> bool:
        """Whether to wait where it is for the vote of the next answers: at rest none come without parallax."""
        at_rest = s.speed_m_s <= self._config.moving_m_s and self._evidence.lacks_parallax()
        return reason == LOOK_AGAIN and not at_rest

    def _from_turn(self, s: Situation) -> Change | None:
        if s.reached:
            return State.FOLLOW, "at the goal"
        if s.gap is not None:
            return State.STEER, GAP_SEEN
        plan = self._plan
        episode = plan.episode
        if episode is None:  # ended by a new goal while turning
            state, reason = self.choose(s)
            if state is not State.TURN:
                return state, reason
            episode = plan.begin_or_keep_episode(s.pose)
            plan.begin_turn(s.pose, s.now_ns)
        if episode.sweep_rad >= math.tau - 1e-6:
            return State.HOLD, NO_WAY_OUT
        step_s = self._config.turn_step_deg / self._config.yaw_rate_deg_s
        done = abs(wrap_rad(plan.turn_target_rad - s.look_rad)) <= TURN_DONE_RAD
        if not done and self._standing.for_s(s.now_ns) <= 2 * step_s + 3:
            return None
        episode.sweep_rad += math.radians(self._config.turn_step_deg)
        return State.PROBE, "turned"

    def _from_probe(self, s: Situation) -> Change | None:
        if s.reached:
            return State.FOLLOW, "at the goal"
        if not self._plan.probed:
            return State.TURN, "nothing to probe"
        if s.wall is not None:
            return State.TURN, s.wall
        if (
            s.answer is not None or s.gap is not None
        ):  # an answer newer than the probe, see Plan.begin_probe()
            state, reason = self.choose(s)
            # A way that was not looked through is held before as soon as the vehicle rests: the step that shows its sides is made first.
            if state is not State.HOLD and not self._waits_to_look(state, s):
                return state, reason
        if self._standing.for_s(s.now_ns) < self._config.probe_timeout_s:
            return None
        newest = self._evidence.last_report
        if newest is not None and self._evidence.says_no_texture():
            return State.HOLD, newest.reason
        if any(vote is not None for vote in self._evidence.votes):
            return State.TURN, "wall ahead"
        return State.TURN, "probe brought no answer"

    def _from_hold(self, s: Situation) -> Change | None:
        standing = self._standing
        if standing.gave_up:
            return None
        if standing.reason == NO_WAY_OUT:
            return (State.FOLLOW, "at the goal") if s.reached else None
        state, reason = self.choose(s)
        if state is not State.HOLD:
            return state, reason
        if (
            s.wants_to_move
            and reason != TURNS_ALONG
            and standing.for_s(s.now_ns) >= self._config.hold_probe_s
        ):
            probe = self._plan.probe_choice(s.pose, s.look_rad, s.now_ns)
            if not self._evidence.says_no_texture() and probe is not None:
                return State.PROBE, "no parallax"
        if s.now_ns - standing.reason_ns < _REASON_KEPT_NS:
            return None  # the detector's reasons may change with every picture
        return State.HOLD, reason
