"""The switch S (paper Fig. 2): which setpoint reaches the autopilot. No I/O, no clock.

=================  ====================================================================================
module             holds
=================  ====================================================================================
``situation``      what is true now: poses, answers and their ages, put together for one setpoint
``table``          what each state does next (the table of states stands at the top of it)
``plan``           what the present state set out to do: anchor, turn, probe, episode
``command``        what is sent in each state, within the caps on step and yaw rate
this one           the machine: events in, decisions and events out
=================  ====================================================================================

In every state z is the planner's, and nothing is sent while the planner is silent: the autopilot's own
failsafe acts then. Everything that comes in is a value with the time when it was true; everything that goes
out is a :data:`~companion.guidance.setpoint.Decision` on one setpoint, in local NED, and events for the log.
``dialect`` and ``wish`` translate between the kinds of setpoints and local NED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config import GuidanceConfig
from companion.guidance.command import Command
from companion.guidance.coordinates import heading_rad
from companion.guidance.observation import DetectionReport, Pose
from companion.guidance.plan import Plan
from companion.guidance.setpoint import Decision, Drop, Forward, Stay
from companion.guidance.situation import Evidence, Situation
from companion.guidance.table import GAP_SEEN, HELD_STATES, NO_WAY_OUT, Standing, State, Table
from companion.guidance.wish import Wish

__all__ = ["Event", "GaveUp", "State", "StateChanged", "Switch"]

_GAVE_UP = "gave up: "
_PROGRESS_M = 0.75
"""Flown this far, the vehicle is not stuck. More than a probe's step."""


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


class Switch:
    """The switch S as a state machine: events in, decisions and events out.

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
        self._engaged: bool | None = None  # None: no heartbeat of the autopilot yet
        self._faults: dict[str, str] = {}
        self._events: list[Event] = []
        self._standing = Standing()
        self._evidence = Evidence(config, camera_yaw_rad=camera_yaw_rad, vehicle_width_m=vehicle_width_m)
        self._plan = Plan(config, self._evidence)
        self._table = Table(config, self._evidence, self._plan, self._standing)
        self._command = Command(
            config, self._evidence, self._plan, self._table, camera_yaw_rad=camera_yaw_rad
        )
        self._progress: tuple[float, float] | None = None
        self._progress_ns = 0
        self._gave_up_on_fault = False

    # ------------------------------------------------------------------ what it says of itself

    @property
    def state(self) -> State:
        """The present state."""
        return self._standing.state

    @property
    def reason(self) -> str:
        """Why it is in that state."""
        return self._standing.reason

    @property
    def pose(self) -> Pose | None:
        """The vehicle's newest pose in the present local frame, however old; None where none is known."""
        return self._evidence.pose

    def pose_is_fresh(self, now_ns: int) -> bool:
        """Whether that pose may be measured from."""
        pose = self._evidence.pose
        return pose is not None and now_ns - pose.time_ns <= self._config.pose_max_age_s * 1e9

    def drain_events(self) -> list[Event]:
        """Return the events since the last call, oldest first."""
        events, self._events = self._events, []
        return events

    def not_ready(self, now_ns: int) -> str | None:
        """Return the name of the input that is missing or too old, or None when all are good."""
        for reason in self._faults.values():
            return reason
        evidence = self._evidence
        if evidence.pose is None:
            return "no pose from the autopilot"
        if not self.pose_is_fresh(now_ns):
            return "pose too old"
        if evidence.last_report_ns is None:
            return "no detection report yet"
        if now_ns - evidence.last_report_ns > self._config.report_timeout_s * 1e9:
            return "vision silent"
        return None

    # ------------------------------------------------------------------ inputs

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take other limits from the next setpoint on; state and memory stay."""
        self._config = config
        for part in (self._evidence, self._plan, self._table, self._command):
            part.set_limits(config)

    def on_vehicle(self, *, armed: bool, offboard: bool, now_ns: int, off: str | None = None) -> None:
        """Take the autopilot's mode; out of OFFBOARD/GUIDED or disarmed everything is forgotten.

        Parameters
        ----------
        armed, offboard
            As the autopilot says, or as it was just asked for.
        now_ns
            Our monotonic time.
        off
            Why protection is not wanted; setpoints then pass untouched. None: it is wanted.
        """
        engaged = armed and offboard and off is None
        if engaged == self._engaged:
            if armed and offboard and off is not None and off != self.reason:
                self._enter(State.DISENGAGED, off, now_ns)
            return
        was_unknown = self._engaged is None
        self._engaged = engaged
        if not engaged:
            self._forget_flight()
            reason = "disarmed" if not armed else "not in OFFBOARD" if not offboard else off or ""
            if self.state is not State.DISENGAGED or was_unknown:
                self._enter(State.DISENGAGED, reason, now_ns)

    def on_pose(self, pose: Pose, speed_m_s: float) -> None:
        """Take the vehicle's newest pose and horizontal speed."""
        self._evidence.on_pose(pose, speed_m_s)

    def on_estimator_reset(self, now_ns: int, why: str) -> None:
        """Drop all that was measured in the old local frame; stay engaged and anchor the hold anew."""
        self._evidence.drop_local_frame(now_ns)
        self._plan.forget()
        self._progress = None
        self._command.yaw.forget()
        if self._engaged and self.state is not State.DISENGAGED:
            self._enter(State.HOLD, f"estimator reset ({why})", now_ns)

    def set_fault(self, name: str, reason: str | None, now_ns: int) -> None:
        """Take or clear a failure of an input (camera, worker, frame rate): no detection while it lasts."""
        if reason is None:
            self._faults.pop(name, None)
        elif name not in self._faults:
            self._faults[name] = reason
            # What was seen before a failure is not used after it: the gap may hide anything.
            self._evidence.drop_measurements(now_ns)
        else:
            self._faults[name] = reason

    def on_report(self, report: DetectionReport, now_ns: int) -> None:
        """Take one report of the vision worker; one about an older frame than the last is ignored."""
        self._evidence.on_report(report, now_ns)

    def on_setpoint(self, wish: Wish, now_ns: int) -> Decision:
        """Decide what is sent in place of one setpoint of the planner.

        Parameters
        ----------
        wish
            What it asks for.
        now_ns
            Our monotonic time.

        Returns
        -------
        Forward, Rewrite, Stay or Drop
            Drop only where nothing safe can be said: no pose was ever known.
        """
        if wish.goal is not None and not all(map(math.isfinite, wish.goal)):
            return Drop("not finite")
        self._note_goal(wish, now_ns)
        if self._engaged is False:
            return Forward()
        fault = self.not_ready(now_ns) if self._engaged else "no heartbeat from the autopilot"
        pose, goal = self._evidence.pose, wish.goal
        if fault is not None or pose is None or goal is None:
            return self._without_protection(wish, fault or wish.unknown, now_ns)
        situation = self._evidence.situation(wish, goal, pose, now_ns)
        if self._gave_up_on_fault:  # the fault has cleared: what was given up is possible again
            self._standing.gave_up = self._gave_up_on_fault = False
            self._progress = None
        self._watch_progress(pose, wish, self.reason, now_ns)
        if wish.refused:
            if not self._standing.gave_up:
                self._enter(State.HOLD, wish.refused, now_ns)
            return self._command.act(State.HOLD, situation)
        if self.state is State.DISENGAGED:
            self._enter(*self._table.choose(situation), now_ns)
            self._begin_align(situation)
        # A change may make the next one due at once (TURN when 360 deg are swept, PROBE with nothing to
        # probe); each state is left at most once a setpoint, so this ends.
        for _ in State:
            change = self._table.change(situation)
            if change is None or change == (self.state, self.reason):
                break
            self._enter(*change, now_ns)
            situation = self._evidence.situation(wish, goal, pose, now_ns)
            self._begin_align(situation)
        return self._command.act(self.state, situation)

    # ------------------------------------------------------------------ the machine

    def _enter(self, state: State, reason: str, now_ns: int) -> None:
        standing, plan = self._standing, self._plan
        previous = standing.state
        if state is previous and reason == standing.reason:
            return
        self._events.append(StateChanged(now_ns, previous, state, reason))
        standing.reason = reason
        standing.reason_ns = now_ns
        if state is previous:
            return  # HOLD with another reason: its anchor and its time stay
        lasted_s = standing.for_s(now_ns)
        standing.state = state
        standing.entered_ns = now_ns
        if state not in HELD_STATES:
            plan.anchor = None
        pose = self._evidence.pose
        if pose is None:
            return
        if state in HELD_STATES and plan.anchor is None:
            plan.set_anchor(pose)
        elif state is State.HOLD:
            plan.anchor_yaw_rad = heading_rad(pose.q_ned_from_body)
        # One that had its time counts as made whatever the pose says: an estimate may stand still while the vehicle does not.
        if previous is State.PROBE and lasted_s < self._config.probe_timeout_s:
            plan.cut_probe_short(pose)
        if state is State.STEER:
            plan.steer_start = (pose.north_m, pose.east_m)
        if state is State.TURN or (state is State.STEER and reason != GAP_SEEN):
            plan.begin_or_keep_episode(pose)
        if state is State.TURN:
            self._evidence.gaps.forget()  # what led here was no way on
            plan.begin_turn(pose, now_ns)
        if state is State.PROBE:
            plan.begin_probe(pose, now_ns)

    def _begin_align(self, s: Situation) -> None:
        if self.state is State.ALIGN and self._standing.entered_ns == s.now_ns:
            self._plan.begin_align(s.look_rad, s.off_axis_rad)

    def _without_protection(self, wish: Wish, fault: str, now_ns: int) -> Decision:
        """Hold, or pass where the user allowed it: an input is missing or too old."""
        if self._config.allow_unprotected and self.state is State.DISENGAGED:
            reason = f"unprotected: {fault}"
            if self.reason != reason:
                self._enter(State.DISENGAGED, reason, now_ns)
            return Forward()
        gave_up = self._standing.gave_up
        self._enter(State.HOLD, f"{_GAVE_UP}{fault}" if gave_up else fault, now_ns)
        pose = self._evidence.pose
        if self._plan.anchor is None and pose is not None:
            self._plan.set_anchor(pose)
        nothing = Stay("held") if wish.is_relative else Drop(f"no pose to hold: {fault}")
        if pose is None:
            return nothing
        self._watch_progress(pose, wish, fault, now_ns)
        return self._command.hold_blindly(now_ns) or nothing

    def _note_goal(self, wish: Wish, now_ns: int) -> None:
        if wish.goal is not None and self._evidence.goal.note(wish.goal, now_ns):
            self._plan.episode = None
            self._standing.gave_up = False
            self._progress = None
            if self.state is State.HOLD and self.reason == NO_WAY_OUT:
                self._standing.reason = "new goal"
        pose = self._evidence.pose
        if pose is not None:
            self._plan.end_episode_left_behind(pose)
        episode = self._plan.episode
        self._evidence.blocked = episode.blocked_rad if episode is not None and episode.has_turned else ()

    def _watch_progress(self, pose: Pose, wish: Wish, why: str, now_ns: int) -> None:
        """Give up, once, where the vehicle has got nowhere for ``give_up_s`` although the planner wants to."""
        here = (pose.north_m, pose.east_m)
        wants_to_move = wish.wants_to_move(wish.goal_m(pose), self._config.arrive_radius_m)
        if not wants_to_move or self._progress is None or math.dist(self._progress, here) > _PROGRESS_M:
            self._progress, self._progress_ns = here, now_ns
            self._standing.gave_up = self._gave_up_on_fault = False
            return
        if self._standing.gave_up or now_ns - self._progress_ns < self._config.give_up_s * 1e9:
            return
        self._standing.gave_up = True
        self._gave_up_on_fault = self.not_ready(now_ns) is not None
        self._enter(State.HOLD, f"{_GAVE_UP}{why}", now_ns)
        self._events.append(GaveUp(now_ns, why, self._config.give_up == "autopilot_hold"))

    def _forget_flight(self) -> None:
        self._evidence.forget_flight()
        self._plan.forget()
        self._command.yaw.forget()
        self._progress = None
        self._standing.gave_up = self._gave_up_on_fault = False
