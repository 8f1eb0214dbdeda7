"""The switch S (paper Fig. 2): which setpoint reaches the autopilot. One table, no I/O.

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

In every state z is the planner's, and nothing is sent while the planner is silent: the autopilot's own
failsafe acts then. Everything that comes in is a value with the time when it was true; everything that goes
out is a :class:`~companion.guidance.setpoint.Verdict` for one setpoint, and events for the log.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from companion.config import GuidanceConfig
from companion.guidance.coordinates import azimuth_of_body_ray, heading_rad, wrap_rad
from companion.guidance.freshness import expiry
from companion.guidance.memory import Episode, SeenBearings, Track
from companion.guidance.observation import DetectionReport, Pose
from companion.guidance.setpoint import Drop, Forward, LocalSetpoint, Rewrite, TypeMask, Verdict

_NO_PARALLAX = ("no_motion", "no_earlier_frame")
"""Reasons of the detector that say nothing about the scene: the last answer stays and ages."""
_MIN_STEP_M = 0.2
"""A way that is not free for this much (beyond the margin) is blocked."""
_NEW_GOAL_M = 0.5
"""A goal that jumps further than this from one setpoint to the next is a new one."""
_GOAL_SPEED_M_S = 3.0
"""Up to this speed a goal that is streamed slowly is taken to move, not to be a new one each time."""
_GOAL_STILL_M = 0.1
_ARRIVED_FACTOR = 1.5
"""Once arrived, the goal stays reached up to this many arrival radii: a hovering vehicle wanders."""
_MEASURED_FREE_FACTOR = 0.7
"""In FOLLOW this share of a step measured free is enough to stay: the step is shortened to it anyway."""
_LOOK_AGAIN = "way blocked, looking again"
"""One answer says that no way is open: no step is made, and the vote of the next answers decides."""
_NO_WAY_OUT = "no way out"
_GAVE_UP = "gave up: "
_PROGRESS_M = 0.75
"""Flown this far, the vehicle is not stuck. More than a probe's step."""
_TURN_DONE_RAD = math.radians(5.0)
_COMMAND_RECENT_NS = 500_000_000
_MAX_SLEW_DT_S = 0.2
_MAX_YAW_LEAD_RAD = math.radians(30.0)
"""A commanded yaw is never further ahead of the heading: a vehicle that could not turn must not snap round."""
_FUTURE_NS = 100_000_000
"""A report about a frame further ahead of our time than this is refused: its clock is not ours."""
_PAIR_AGE_NS = 4_000_000_000
"""Where a report does not name its earlier frame, that frame may be this much older than the later one."""
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


_HELD_STATES = (State.ALIGN, State.TURN, State.HOLD)
"""States whose x, y stay at one anchor, which is kept when one of them follows another."""


@dataclass(frozen=True, slots=True)
class StateChanged:
    """The switch went from one state to another, or HOLD has another reason."""

    time_ns: int
    previous: State
    state: State
    reason: str


@dataclass(frozen=True, slots=True)
class GaveUp:
    """No way was found for ``give_up_s``; whether the autopilot is to be asked for its own hold mode."""

    time_ns: int
    reason: str
    ask_autopilot: bool


Event = StateChanged | GaveUp


@dataclass(frozen=True, slots=True)
class _Answer:
    """A direction that the detector gave, or the way up to a plane too far away to be a wall yet."""

    report: DetectionReport
    azimuth_rad: float
    is_plane: bool


@dataclass(frozen=True, slots=True)
class _Situation:
    """All that one decision looks at."""

    now_ns: int
    setpoint: LocalSetpoint
    pose: Pose
    speed_m_s: float
    look_rad: float
    bearing_rad: float
    goal_m: float
    reached: bool
    off_axis_rad: float
    answer: _Answer | None
    no_answer: str
    wall: str | None
    free_bearing_m: float | None


class Switch:
    """The switch S as a state machine: events in, verdicts and events out.

    Parameters
    ----------
    config
        Limits and distances.
    camera_yaw_rad
        Azimuth of the camera's axis relative to the body's forward axis (its mounting).
    vehicle_width_m
        With margins: what must fit between remembered obstacles.
    """

    def __init__(
        self, config: GuidanceConfig, *, camera_yaw_rad: float = 0.0, vehicle_width_m: float = 0.9
    ) -> None:
        self._config = config
        self._camera_yaw_rad = camera_yaw_rad
        self._state = State.DISENGAGED
        self._reason = "start"
        self._entered_ns = 0
        self._reason_ns = 0
        self._events: list[Event] = []
        # inputs
        self._engaged: bool | None = None  # None: no heartbeat of the autopilot yet
        self._faults: dict[str, str] = {}
        self._pose: Pose | None = None
        self._speed_m_s = 0.0
        self._last_report_ns: int | None = None
        self._newest_frame_ns = -(1 << 62)
        self._goal: tuple[float, float] | None = None
        self._goal_before: tuple[float, float] | None = None
        self._goal_seen_ns = 0
        self._arrived = False
        self._goal_still: tuple[float, float] = (0.0, 0.0)
        self._goal_still_since_ns = 0
        # memory, cleared when the mode is left
        self._answer: _Answer | None = None
        self._last_report: DetectionReport | None = None
        self._bad_reports = 0
        self._votes: deque[DetectionReport | None] = deque(maxlen=config.wall_n)
        self._answers_after_ns = -(1 << 62)
        self._pairs_after_ns = -(1 << 62)
        self._seen = SeenBearings(config, vehicle_width_m)
        self._track = Track()
        self._episode: Episode | None = None
        self._anchor: tuple[float, float] | None = None
        self._anchor_yaw_rad = 0.0
        self._turn_target_rad = 0.0
        self._probe_target: tuple[float, float] = (0.0, 0.0)
        self._probe_yaw_rad = 0.0
        self._probed = ""
        self._steer_start: tuple[float, float] = (0.0, 0.0)
        self._commanded_yaw_rad = 0.0
        self._commanded_ns = -(1 << 62)
        self._progress: tuple[float, float] | None = None
        self._progress_ns = 0
        self._gave_up = False
        self._gave_up_on_fault = False
        self._handlers: dict[State, Callable[[_Situation], tuple[State, str] | None]] = {
            State.FOLLOW: self._from_follow,
            State.ALIGN: self._from_align,
            State.STEER: self._from_steer,
            State.TURN: self._from_turn,
            State.PROBE: self._from_probe,
            State.HOLD: self._from_hold,
        }

    # ------------------------------------------------------------------ what it says of itself

    @property
    def state(self) -> State:
        """The present state."""
        return self._state

    @property
    def reason(self) -> str:
        """Why it is in that state."""
        return self._reason

    def drain_events(self) -> list[Event]:
        """Return the events since the last call, oldest first."""
        events, self._events = self._events, []
        return events

    def not_ready(self, now_ns: int) -> str | None:
        """Return the name of the input that is missing or too old, or None when all are good."""
        for reason in self._faults.values():
            return reason
        if self._pose is None:
            return "no pose from the autopilot"
        if now_ns - self._pose.time_ns > self._config.pose_max_age_s * 1e9:
            return "pose too old"
        if self._last_report_ns is None:
            return "no detection report yet"
        if now_ns - self._last_report_ns > self._config.report_timeout_s * 1e9:
            return "vision silent"
        return None

    # ------------------------------------------------------------------ inputs

    def on_vehicle(self, *, armed: bool, offboard: bool, now_ns: int) -> None:
        """Take the autopilot's mode; out of OFFBOARD/GUIDED or disarmed everything is forgotten."""
        engaged = armed and offboard
        if engaged == self._engaged:
            return
        was_unknown = self._engaged is None
        self._engaged = engaged
        if not engaged:
            self._forget_flight()
            reason = "disarmed" if not armed else "not in OFFBOARD"
            if self._state is not State.DISENGAGED or was_unknown:
                self._enter(State.DISENGAGED, reason, now_ns)

    def on_pose(self, pose: Pose, speed_m_s: float) -> None:
        """Take the vehicle's newest pose and horizontal speed."""
        self._pose = pose
        self._speed_m_s = speed_m_s
        self._track.add(pose.north_m, pose.east_m)

    def on_estimator_reset(self, now_ns: int, why: str) -> None:
        """Drop all that was measured in the old local frame; stay engaged and anchor the hold anew."""
        self._pose = None
        self._drop_measurements(now_ns)
        self._pairs_after_ns = now_ns
        self._seen.clear()
        self._track.clear()
        self._episode = None
        self._anchor = None
        self._arrived = False
        self._progress = None
        self._commanded_ns = -(1 << 62)
        if self._engaged and self._state is not State.DISENGAGED:
            self._enter(State.HOLD, f"estimator reset ({why})", now_ns)

    def set_fault(self, name: str, reason: str | None, now_ns: int) -> None:
        """Take or clear a failure of an input (camera, worker, frame rate): no detection while it lasts."""
        if reason is None:
            self._faults.pop(name, None)
        elif name not in self._faults:
            self._faults[name] = reason
            # What was seen before a failure is not used after it: the gap may hide anything.
            self._drop_measurements(now_ns)
        else:
            self._faults[name] = reason

    def on_report(self, report: DetectionReport, now_ns: int) -> None:
        """Take one report of the vision worker; one about an older frame than the last is ignored.

        So is one about a frame of the future: it would make all later ones look old.
        """
        if report.frame_ns <= self._newest_frame_ns or report.frame_ns > now_ns + _FUTURE_NS:
            return
        self._newest_frame_ns = report.frame_ns
        self._last_report_ns = now_ns
        self._last_report = report
        if report.kind == "none":
            if report.reason not in _NO_PARALLAX:
                self._bad_reports += 1
                if self._bad_reports >= self._config.bad_reports_to_hold:
                    self._answer = None
            return
        if report.frame_ns < self._answers_after_ns or report.pose is None:
            return
        if _pair_began_ns(report) < self._pairs_after_ns:
            return  # its two poses are not of one local frame: the way flown between them is not known
        self._bad_reports = 0
        self._seen.add(report)
        if report.kind == "single_plane":
            self._votes.append(report)
            if report.distance_m is not None and report.distance_m > self._wall_range_m(math.inf):
                look = heading_rad(report.pose.q_ned_from_body) + self._camera_yaw_rad
                self._answer = _Answer(report, wrap_rad(look), is_plane=True)
            return
        if report.ray_body is None:
            return
        azimuth = azimuth_of_body_ray(report.ray_body, report.pose.q_ned_from_body)
        if azimuth is None:
            return
        self._answer = _Answer(report, azimuth, is_plane=False)
        self._votes.append(report if self._is_boxed_in(azimuth, now_ns) else None)

    def on_setpoint(self, setpoint: LocalSetpoint, now_ns: int) -> Verdict:
        """Decide what is sent in place of one position setpoint of the planner.

        Parameters
        ----------
        setpoint
            A position setpoint in LOCAL_NED (x, y, z used).
        now_ns
            Our monotonic time.

        Returns
        -------
        Forward, Rewrite or Drop
            Drop only where nothing safe can be said: no pose was ever known.
        """
        if setpoint.nonfinite_used_fields():
            return Drop("not finite")
        self._note_goal(setpoint, now_ns)
        if self._engaged is False:
            return Forward()
        fault = self.not_ready(now_ns) if self._engaged else "no heartbeat from the autopilot"
        if fault is not None:
            return self._without_protection(setpoint, fault, now_ns)
        pose = self._pose
        if pose is None:  # not_ready() has said so
            return Drop("no pose")
        situation = self._situation(setpoint, pose, now_ns)
        if self._gave_up_on_fault:  # the fault has cleared: what was given up is possible again
            self._gave_up = self._gave_up_on_fault = False
            self._progress = None
        self._watch_progress(pose, setpoint, self._reason, now_ns)
        if self._state is State.DISENGAGED:
            self._enter(*self._choose(situation), now_ns)
        # A change may make the next one due at once (TURN when 360 deg are swept, PROBE with nothing to
        # probe); each state is left at most once a setpoint, so this ends.
        for _ in State:
            change = self._handlers[self._state](situation)
            if change is None or change == (self._state, self._reason):
                break
            self._enter(*change, now_ns)
            situation = self._situation(setpoint, pose, now_ns)
        return self._act(situation)

    # ------------------------------------------------------------------ what the inputs mean together

    def _situation(self, setpoint: LocalSetpoint, pose: Pose, now_ns: int) -> _Situation:
        config = self._config
        to_north, to_east = setpoint.x - pose.north_m, setpoint.y - pose.east_m
        goal_m = math.hypot(to_north, to_east)
        look = wrap_rad(heading_rad(pose.q_ned_from_body) + self._camera_yaw_rad)
        bearing = math.atan2(to_east, to_north) if goal_m > 1e-6 else look
        answer, no_answer = self._good_answer(pose, now_ns)
        wall = self._wall(goal_m, pose, now_ns)
        free_bearing_m = self._seen.free_m(bearing, pose, self._speed_m_s, now_ns)
        still_s = (now_ns - self._goal_still_since_ns) / 1e9
        radius_m = config.arrive_radius_m * (_ARRIVED_FACTOR if self._arrived else 1.0)
        nothing_nearer = wall is None and (free_bearing_m is None or free_bearing_m >= goal_m)
        reached = goal_m <= radius_m and still_s >= config.goal_settle_s and nothing_nearer
        self._arrived = reached
        return _Situation(
            now_ns=now_ns,
            setpoint=setpoint,
            pose=pose,
            speed_m_s=self._speed_m_s,
            look_rad=look,
            bearing_rad=bearing,
            goal_m=goal_m,
            reached=reached,
            off_axis_rad=abs(wrap_rad(bearing - look)),
            answer=answer,
            no_answer=no_answer,
            wall=wall,
            free_bearing_m=free_bearing_m,
        )

    def _good_answer(self, pose: Pose, now_ns: int) -> tuple[_Answer | None, str]:
        if self._answer is None:
            last = self._last_report
            if last is not None and last.kind == "none":
                return None, last.reason
            return None, "no answer yet"
        why = expiry(self._answer.report, pose, self._speed_m_s, now_ns, self._config)
        return (self._answer, "") if why is None else (None, "last answer used up")

    def _wall_range_m(self, goal_m: float) -> float:
        return min(goal_m, self._config.wall_limit_m) + self._config.wall_margin_m

    def _wall(self, goal_m: float, pose: Pose, now_ns: int) -> str | None:
        """Return what stands in the way when enough of the last answers say so, else None."""
        limit_m = self._wall_range_m(goal_m)
        votes = 0
        boxed_in = 0
        for report in self._votes:
            if report is None or expiry(report, pose, self._speed_m_s, now_ns, self._config):
                continue
            if report.kind != "single_plane":
                boxed_in += 1
                continue
            if report.distance_m is None or self._remaining_m(report, pose) <= limit_m:
                votes += 1
        if votes + boxed_in < self._config.wall_k:
            return None
        return "wall ahead" if votes >= boxed_in else "no way ahead"

    @staticmethod
    def _remaining_m(report: DetectionReport, pose: Pose) -> float:
        origin = report.pose
        if report.distance_m is None or origin is None:
            return 0.0
        moved_m = math.hypot(pose.north_m - origin.north_m, pose.east_m - origin.east_m)
        return report.distance_m - moved_m

    def _is_boxed_in(self, void_rad: float, now_ns: int) -> bool:
        """Whether both the void and the goal's bearing are measured to be blocked at close range."""
        pose = self._pose
        if pose is None or self._goal is None:
            return False
        bearing = math.atan2(self._goal[1] - pose.east_m, self._goal[0] - pose.north_m)
        goal_m = math.hypot(self._goal[1] - pose.east_m, self._goal[0] - pose.north_m)
        return not self._is_open(
            self._seen.free_m(void_rad, pose, self._speed_m_s, now_ns), math.inf
        ) and not self._is_open(self._seen.free_m(bearing, pose, self._speed_m_s, now_ns), goal_m)

    def _is_open(self, free_m: float | None, goal_m: float) -> bool:
        """Whether a way is not known to be blocked for the least step."""
        return free_m is None or free_m - self._config.step_margin_m >= min(goal_m, _MIN_STEP_M)

    def _agrees(self, s: _Situation) -> bool:
        """Whether the void lies at the goal's bearing, or a plane that fills the view is far enough."""
        if s.answer is None:
            return False
        if s.answer.is_plane:  # only asked while the bearing is in view, so it points at this plane
            return True
        limit_deg = self._config.agree_deg
        if self._state is State.FOLLOW:
            limit_deg += self._config.agree_hysteresis_deg
        return abs(wrap_rad(s.answer.azimuth_rad - s.bearing_rad)) <= math.radians(limit_deg)

    def _is_measured_free(self, s: _Situation) -> bool:
        """Whether the whole next step toward the goal is known to be free."""
        step_m = min(s.goal_m, self._config.max_step_m)
        if self._state is State.FOLLOW:
            step_m *= _MEASURED_FREE_FACTOR
        return (
            s.free_bearing_m is not None
            and s.free_bearing_m - self._config.step_margin_m >= step_m
            and self._seen.is_measured(s.bearing_rad, s.pose, s.speed_m_s, s.now_ns)
        )

    def _choose(self, s: _Situation) -> tuple[State, str]:
        """Return the state that the situation asks for, whatever the present one."""
        if s.reached:
            return State.FOLLOW, "at the goal"
        in_view = s.off_axis_rad <= math.radians(self._config.view_deg)
        blocked_before = self._episode is not None and self._episode.is_blocked(s.bearing_rad)
        if s.wall is not None:
            return State.TURN, s.wall
        if s.answer is None:
            if in_view or blocked_before:
                return State.HOLD, s.no_answer
            return State.ALIGN, "goal out of view"
        if not in_view and not blocked_before:
            return State.ALIGN, "goal out of view"
        if in_view and self._is_open(s.free_bearing_m, s.goal_m):
            if self._is_measured_free(s):
                return State.FOLLOW, "way measured free"
            if self._agrees(s):
                return State.FOLLOW, "void agrees"
        if self._is_open(self._void_free_m(s.answer, s), math.inf) and not (in_view and self._agrees(s)):
            return State.STEER, "void elsewhere"
        return State.HOLD, _LOOK_AGAIN

    def _void_free_m(self, answer: _Answer, s: _Situation) -> float | None:
        """Return what is known of the free distance along the answer's direction."""
        free_m = self._seen.free_m(answer.azimuth_rad, s.pose, s.speed_m_s, s.now_ns)
        if answer.is_plane:
            plane_m = self._remaining_m(answer.report, s.pose)
            free_m = plane_m if free_m is None else min(free_m, plane_m)
        return free_m

    # ------------------------------------------------------------------ the table: when a state is left

    def _from_follow(self, s: _Situation) -> tuple[State, str] | None:
        state, reason = self._choose(s)
        return None if state is State.FOLLOW or reason == _LOOK_AGAIN else (state, reason)

    def _from_align(self, s: _Situation) -> tuple[State, str] | None:
        if s.reached:
            return State.FOLLOW, "at the goal"
        if s.off_axis_rad <= 0.6 * math.radians(self._config.view_deg):
            return self._choose(s)
        turn_s = math.pi / math.radians(self._config.yaw_rate_deg_s)
        if self._in_state_s(s.now_ns) > 2 * turn_s + 3:
            return State.HOLD, "the vehicle does not turn"
        return None

    def _from_steer(self, s: _Situation) -> tuple[State, str] | None:
        state, reason = self._choose(s)
        if state is State.ALIGN and s.answer is not None:
            flown_m = math.dist(self._steer_start, (s.pose.north_m, s.pose.east_m))
            if flown_m >= self._config.commit_distance_m:
                return State.ALIGN, "looking towards the goal again"
            # Without a way to go on along, there is nothing to be committed to.
            return None if self._is_open(self._void_free_m(s.answer, s), math.inf) else (state, reason)
        return None if state is State.STEER or reason == _LOOK_AGAIN else (state, reason)

    def _from_turn(self, s: _Situation) -> tuple[State, str] | None:
        if s.reached:
            return State.FOLLOW, "at the goal"
        episode = self._episode
        if episode is None:  # ended by a new goal while turning
            state, reason = self._choose(s)
            if state is not State.TURN:
                return state, reason
            episode = self._begin_or_keep_episode(s.pose)
            self._begin_turn(s.pose)
        if episode.sweep_rad >= math.tau - 1e-6:
            return State.HOLD, _NO_WAY_OUT
        step_s = self._config.turn_step_deg / self._config.yaw_rate_deg_s
        done = abs(wrap_rad(self._turn_target_rad - s.look_rad)) <= _TURN_DONE_RAD
        if not done and self._in_state_s(s.now_ns) <= 2 * step_s + 3:
            return None
        episode.sweep_rad += math.radians(self._config.turn_step_deg)
        return State.PROBE, "turned"

    def _from_probe(self, s: _Situation) -> tuple[State, str] | None:
        if s.reached:
            return State.FOLLOW, "at the goal"
        if not self._probed:
            return State.TURN, "nothing to probe"
        newest = self._last_report
        if s.wall is not None:
            return State.TURN, s.wall
        if s.answer is not None:  # newer than the probe's beginning, see _begin_probe()
            state, reason = self._choose(s)
            if state is not State.HOLD:
                return state, reason
        if self._in_state_s(s.now_ns) < self._config.probe_timeout_s:
            return None
        if newest is not None and newest.kind == "none" and newest.reason not in _NO_PARALLAX:
            return State.HOLD, newest.reason
        if any(vote is not None for vote in self._votes):
            return State.TURN, "wall ahead"
        return State.TURN, "probe brought no answer"

    def _from_hold(self, s: _Situation) -> tuple[State, str] | None:
        if self._gave_up:
            return None
        if self._reason == _NO_WAY_OUT:
            return (State.FOLLOW, "at the goal") if s.reached else None
        state, reason = self._choose(s)
        if state is not State.HOLD:
            return state, reason
        wants_to_move = s.goal_m > self._config.arrive_radius_m
        if wants_to_move and self._in_state_s(s.now_ns) >= self._config.hold_probe_s:
            last = self._last_report
            no_texture = last is not None and last.kind == "none" and last.reason not in _NO_PARALLAX
            if not no_texture and self._probe_choice(s) is not None:
                return State.PROBE, "no parallax"
        if s.now_ns - self._reason_ns < _REASON_KEPT_NS:
            return None  # the detector's reasons may change with every picture
        return State.HOLD, reason

    # ------------------------------------------------------------------ entering a state

    def _enter(self, state: State, reason: str, now_ns: int) -> None:
        previous = self._state
        if state is previous and reason == self._reason:
            return
        self._events.append(StateChanged(now_ns, previous, state, reason))
        self._reason = reason
        self._reason_ns = now_ns
        if state is previous:
            return  # HOLD with another reason: its anchor and its time stay
        self._state = state
        self._entered_ns = now_ns
        if state not in _HELD_STATES:
            self._anchor = None
        pose = self._pose
        if pose is None:
            return
        here = (pose.north_m, pose.east_m)
        if state in _HELD_STATES and self._anchor is None:
            self._set_anchor(pose)
        elif state is State.HOLD:
            self._anchor_yaw_rad = heading_rad(pose.q_ned_from_body)
        if state is State.STEER:
            self._steer_start = here
        if state in (State.STEER, State.TURN):
            self._begin_or_keep_episode(pose)
        if state is State.TURN:
            self._begin_turn(pose)
        if state is State.PROBE:
            self._begin_probe(pose, now_ns)

    def _set_anchor(self, pose: Pose) -> None:
        self._anchor = (pose.north_m, pose.east_m)
        self._anchor_yaw_rad = heading_rad(pose.q_ned_from_body)

    def _begin_or_keep_episode(self, pose: Pose) -> Episode:
        episode = self._episode
        if episode is None or episode.over(pose, self._config.episode_distance_m):
            episode = self._episode = Episode(pose.north_m, pose.east_m)
        if self._goal is not None:
            bearing = math.atan2(self._goal[1] - pose.east_m, self._goal[0] - pose.north_m)
            episode.block(bearing, pose)
        return episode

    def _begin_turn(self, pose: Pose) -> None:
        look = wrap_rad(heading_rad(pose.q_ned_from_body) + self._camera_yaw_rad)
        episode = self._episode
        if episode is None:
            return
        if episode.side == 0:
            to_goal = 0.0
            if self._goal is not None:
                bearing = math.atan2(self._goal[1] - pose.east_m, self._goal[0] - pose.north_m)
                to_goal = wrap_rad(bearing - look)
            episode.side = -1 if to_goal < -math.radians(5.0) else 1
        # From where the last turn was to end, not from where it was found done: twelve steps of 30 are 360.
        goes_on = episode.sweep_rad > 0 and abs(wrap_rad(self._turn_target_rad - look)) <= 2 * _TURN_DONE_RAD
        start = self._turn_target_rad if goes_on else look
        self._turn_target_rad = wrap_rad(start + episode.side * math.radians(self._config.turn_step_deg))

    def _begin_probe(self, pose: Pose, now_ns: int) -> None:
        """Choose where to step, and take only answers from now on: those before were at another heading."""
        here = (pose.north_m, pose.east_m)
        look = wrap_rad(heading_rad(pose.q_ned_from_body) + self._camera_yaw_rad)
        choice = self._probe_point(pose, look, now_ns)
        self._probe_yaw_rad = heading_rad(pose.q_ned_from_body)
        self._answer = None
        self._votes.clear()
        self._answers_after_ns = now_ns
        if choice is None:
            self._probed = ""
            self._probe_target = here
            return
        self._probed, self._probe_target = choice
        if self._probed == "camera axis":
            if self._episode is None:
                self._episode = Episode(*here)
            self._episode.bootstrap(look)

    def _probe_choice(self, s: _Situation) -> tuple[str, tuple[float, float]] | None:
        return self._probe_point(s.pose, s.look_rad, s.now_ns)

    def _probe_point(
        self, pose: Pose, look_rad: float, now_ns: int
    ) -> tuple[str, tuple[float, float]] | None:
        config = self._config
        step_m = config.probe_step_m
        north_m, east_m = pose.north_m, pose.east_m

        def along(azimuth_rad: float) -> tuple[float, float]:
            return north_m + step_m * math.cos(azimuth_rad), east_m + step_m * math.sin(azimuth_rad)

        free = self._seen.free_azimuths(step_m + config.step_margin_m, pose, self._speed_m_s, now_ns)
        if free:
            azimuth, _ = min(free, key=lambda item: abs(wrap_rad(item[0] - look_rad)))
            return "seen free", along(azimuth)
        back = self._track.back(north_m, east_m, step_m)
        if back is not None:
            azimuth = math.atan2(back[1] - east_m, back[0] - north_m)
            return "flown track", along(azimuth)
        blocked = self._seen.free_m(look_rad, pose, self._speed_m_s, now_ns) is not None
        half_step = math.radians(config.turn_step_deg) / 2
        used = self._episode is not None and self._episode.was_bootstrapped(look_rad, half_step)
        if config.bootstrap_probe and not blocked and not used:
            return "camera axis", along(look_rad)
        return None

    # ------------------------------------------------------------------ what is sent

    def _act(self, s: _Situation) -> Verdict:
        here = (s.pose.north_m, s.pose.east_m)
        if self._state is State.FOLLOW:
            return self._follow(s)
        if self._state is State.STEER and s.answer is not None:
            psi = s.answer.azimuth_rad
            step_m = self._step_m(s.goal_m, self._void_free_m(s.answer, s))
            out_of_sight = abs(wrap_rad(psi - s.look_rad)) > math.radians(self._config.align_deg)
            if out_of_sight or self._choose(s)[1] == _LOOK_AGAIN:
                step_m = (
                    0.0  # the camera must look where it flies, and no way is open before it is seen again
                )
            x, y = here[0] + step_m * math.cos(psi), here[1] + step_m * math.sin(psi)
            return self._rewrite(x, y, psi - self._camera_yaw_rad, "substituted", s)
        if self._state is State.PROBE:
            return self._rewrite(*self._probe_target, self._probe_yaw_rad, "substituted", s)
        if self._anchor is None:
            self._set_anchor(s.pose)
        x, y = self._anchor or here
        if self._state is State.ALIGN:
            return self._rewrite(x, y, s.bearing_rad - self._camera_yaw_rad, "turned", s)
        if self._state is State.TURN:
            self._anchor_yaw_rad = wrap_rad(self._turn_target_rad - self._camera_yaw_rad)
            return self._rewrite(x, y, self._anchor_yaw_rad, "turned", s)
        return self._rewrite(x, y, self._anchor_yaw_rad, "held", s)

    def _step_m(self, goal_m: float, free_m: float | None) -> float:
        step_m = min(goal_m, self._config.max_step_m)
        if free_m is not None:
            step_m = min(step_m, free_m - self._config.step_margin_m)
        return max(0.0, step_m)

    def _follow(self, s: _Situation) -> Verdict:
        sp = s.setpoint
        yaw_used = not sp.type_mask & TypeMask.YAW_IGNORE
        if s.reached:
            step_m, wanted_yaw = min(s.goal_m, self._config.max_step_m), (sp.yaw if yaw_used else None)
        else:
            free_m = s.free_bearing_m
            if s.answer is not None and s.answer.is_plane:
                plane_m = self._remaining_m(s.answer.report, s.pose)
                free_m = plane_m if free_m is None else min(free_m, plane_m)
            elif s.answer is not None and free_m is None:
                free_m = self._void_free_m(s.answer, s)  # the void agrees: the next best that is known
            step_m = self._step_m(s.goal_m, free_m)
            if self._choose(s)[1] == _LOOK_AGAIN:
                step_m = 0.0
            wanted_yaw = s.bearing_rad - self._camera_yaw_rad
            if yaw_used and abs(wrap_rad(sp.yaw + self._camera_yaw_rad - s.bearing_rad)) <= math.radians(
                self._config.view_deg
            ):
                wanted_yaw = sp.yaw
        whole_step = step_m >= s.goal_m
        slewed = None if wanted_yaw is None else self._slewed(wanted_yaw, s)
        position_and_yaw_only = not any(
            field.startswith(("v", "af", "yaw_rate")) for field in sp.used_fields()
        )
        turns_by_itself = s.reached and not yaw_used  # hover, with or without a slow yaw rate
        if whole_step and (
            (
                position_and_yaw_only
                and slewed is not None
                and abs(wrap_rad(slewed - sp.yaw)) < 1e-6
                and yaw_used
            )
            or (turns_by_itself and self._is_calm(sp))
        ):
            self._commanded(sp.yaw if yaw_used else heading_rad(s.pose.q_ned_from_body), s.now_ns)
            return Forward()
        if whole_step:
            x, y = sp.x, sp.y
        else:
            x = s.pose.north_m + step_m * math.cos(s.bearing_rad)
            y = s.pose.east_m + step_m * math.sin(s.bearing_rad)
        return self._rewrite(x, y, wanted_yaw, "substituted", s, slewed=slewed)

    def _is_calm(self, sp: LocalSetpoint) -> bool:
        """Whether the further terms of a setpoint at the goal cannot carry the vehicle away."""
        used = sp.used_fields()
        if any(field.startswith(("v", "af")) for field in used):
            return False
        return abs(used.get("yaw_rate", 0.0)) <= math.radians(self._config.yaw_rate_deg_s)

    def _rewrite(
        self,
        x: float,
        y: float,
        yaw_rad: float | None,
        action: str,
        s: _Situation,
        *,
        slewed: float | None = None,
    ) -> Rewrite:
        if yaw_rad is None:
            return Rewrite(x, y, None, action)
        yaw = self._slewed(yaw_rad, s) if slewed is None else slewed
        self._commanded(yaw, s.now_ns)
        return Rewrite(x, y, yaw, action)

    def _commanded(self, yaw_rad: float, now_ns: int) -> None:
        self._commanded_yaw_rad = wrap_rad(yaw_rad)
        self._commanded_ns = now_ns

    def _slewed(self, yaw_rad: float, s: _Situation) -> float:
        """Return the next yaw on the way to ``yaw_rad``: autopilots do not all cap the rate themselves."""
        heading = heading_rad(s.pose.q_ned_from_body)
        since_ns = s.now_ns - self._commanded_ns
        start = heading
        if since_ns <= _COMMAND_RECENT_NS:
            lead = wrap_rad(self._commanded_yaw_rad - heading)
            start += max(-_MAX_YAW_LEAD_RAD, min(_MAX_YAW_LEAD_RAD, lead))
        # A planner of 1-2 Hz is slow, not new: it turns too. After a longer pause the first step is none.
        paused = since_ns > self._config.planner_timeout_s * 1e9
        dt_s = 0.0 if paused else min(since_ns / 1e9, _MAX_SLEW_DT_S)
        cap = math.radians(self._config.yaw_rate_deg_s) * dt_s
        return wrap_rad(start + max(-cap, min(cap, wrap_rad(yaw_rad - start))))

    def _without_protection(self, setpoint: LocalSetpoint, fault: str, now_ns: int) -> Verdict:
        if self._config.allow_unprotected and self._state is State.DISENGAGED:
            reason = f"unprotected: {fault}"
            if self._reason != reason:
                self._enter(State.DISENGAGED, reason, now_ns)
            return Forward()
        self._enter(State.HOLD, f"{_GAVE_UP}{fault}" if self._gave_up else fault, now_ns)
        pose = self._pose
        if self._anchor is None and pose is not None:
            self._set_anchor(pose)
        if self._anchor is None or pose is None:
            return Drop(f"no pose to hold: {fault}")
        self._watch_progress(pose, setpoint, fault, now_ns)
        self._commanded(self._anchor_yaw_rad, now_ns)
        return Rewrite(*self._anchor, self._anchor_yaw_rad, "held")

    # ------------------------------------------------------------------ bookkeeping

    def _in_state_s(self, now_ns: int) -> float:
        return (now_ns - self._entered_ns) / 1e9

    def _note_goal(self, setpoint: LocalSetpoint, now_ns: int) -> None:
        goal = (setpoint.x, setpoint.y)
        since_s = (now_ns - self._goal_seen_ns) / 1e9
        silent = since_s > self._config.planner_timeout_s
        self._goal_seen_ns = now_ns
        jump_m = max(_NEW_GOAL_M, _GOAL_SPEED_M_S * since_s)
        if self._goal is None or silent:
            is_new, self._goal_before = True, None
        elif math.dist(self._goal, goal) <= jump_m:
            is_new = False
        else:
            # Two planners that take turns do not bring a new goal each time.
            before, self._goal_before = self._goal_before, self._goal
            is_new = before is None or math.dist(before, goal) > jump_m
            self._goal_still, self._goal_still_since_ns = goal, now_ns
        if is_new:
            self._episode = None
            self._gave_up = False
            self._progress = None
            self._goal_still, self._goal_still_since_ns = goal, now_ns
            if self._state is State.HOLD and self._reason == _NO_WAY_OUT:
                self._reason = "new goal"
        elif math.dist(self._goal_still, goal) > _GOAL_STILL_M:
            self._goal_still, self._goal_still_since_ns = goal, now_ns
        self._goal = goal
        pose = self._pose
        if (
            self._episode is not None
            and pose is not None
            and self._episode.over(pose, self._config.episode_distance_m)
        ):
            self._episode = None

    def _watch_progress(self, pose: Pose, setpoint: LocalSetpoint, why: str, now_ns: int) -> None:
        """Give up, once, where the vehicle has got nowhere for ``give_up_s`` although the planner wants to."""
        here = (pose.north_m, pose.east_m)
        wants_to_move = math.dist(here, (setpoint.x, setpoint.y)) > self._config.arrive_radius_m
        if not wants_to_move or self._progress is None or math.dist(self._progress, here) > _PROGRESS_M:
            self._progress, self._progress_ns = here, now_ns
            self._gave_up = self._gave_up_on_fault = False
            return
        if self._gave_up or now_ns - self._progress_ns < self._config.give_up_s * 1e9:
            return
        self._gave_up = True
        self._gave_up_on_fault = self.not_ready(now_ns) is not None
        self._enter(State.HOLD, f"{_GAVE_UP}{why}", now_ns)
        self._events.append(GaveUp(now_ns, why, self._config.give_up == "autopilot_hold"))

    def _drop_measurements(self, now_ns: int) -> None:
        self._answer = None
        self._votes.clear()
        self._seen.forget_ranges()
        self._answers_after_ns = now_ns

    def _forget_flight(self) -> None:
        self._answer = None
        self._votes.clear()
        self._seen.clear()
        self._track.clear()
        self._episode = None
        self._anchor = None
        self._progress = None
        self._gave_up = self._gave_up_on_fault = False
        self._goal = self._goal_before = None
        self._arrived = False
        self._commanded_ns = -(1 << 62)


def _pair_began_ns(report: DetectionReport) -> int:
    """Return when the earlier frame of a report's pair was exposed, at the earliest where it is not said."""
    if report.earlier_frame_ns is not None:
        return report.earlier_frame_ns
    return report.frame_ns - _PAIR_AGE_NS
