"""What is sent in each state, within its caps: the longest step, the free distance, the yaw's rate."""

from __future__ import annotations

import math

from companion.config import GuidanceConfig
from companion.guidance.coordinates import heading_rad, wrap_rad
from companion.guidance.observation import Pose
from companion.guidance.plan import Plan
from companion.guidance.setpoint import Decision, Forward, Rewrite
from companion.guidance.situation import Evidence, Situation, remaining_m
from companion.guidance.table import LOOK_AGAIN, State, Table
from companion.guidance.wish import Wish

_ROOMY_M = 0.8
"""With this much room beside the way nothing remembered there limits the step."""
_NO_ROOM_M = 0.3
_STEP_PER_ROOM = 2.0
_LEAST_STEP_M = 0.3
_COMMAND_RECENT_NS = 500_000_000
_MAX_SLEW_DT_S = 0.2
_MAX_YAW_LEAD_RAD = math.radians(30.0)
"""A commanded yaw is never further ahead of the heading: a vehicle that could not turn must not snap round."""


class YawSlew:
    """Caps the rate of the commanded yaw: autopilots do not all cap it themselves.

    Parameters
    ----------
    config
        ``yaw_rate_deg_s``, and the silence after which a planner begins anew.
    """

    def __init__(self, config: GuidanceConfig) -> None:
        self.set_limits(config)
        self._yaw_rad = 0.0
        self._at_ns = -(1 << 62)

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take other limits; the yaw commanded last stays."""
        self._rate_rad_s = math.radians(config.yaw_rate_deg_s)
        self._paused_after_s = config.planner_timeout_s

    def forget(self) -> None:
        """Begin at the heading with the next command."""
        self._at_ns = -(1 << 62)

    def commanded(self, yaw_rad: float, now_ns: int) -> None:
        """Take note of the yaw that leaves."""
        self._yaw_rad = wrap_rad(yaw_rad)
        self._at_ns = now_ns

    def toward(self, yaw_rad: float, pose: Pose, now_ns: int) -> float:
        """Return the next yaw on the way to ``yaw_rad``."""
        start, cap = self._start(pose, now_ns)
        return wrap_rad(start + max(-cap, min(cap, wrap_rad(yaw_rad - start))))

    def turning(self, rate_rad_s: float, pose: Pose, now_ns: int) -> float:
        """Return the next yaw of a turn at the planner's rate, or at the capped one where that is slower."""
        start, cap = self._start(pose, now_ns)
        step = cap * rate_rad_s / self._rate_rad_s
        return wrap_rad(start + max(-cap, min(cap, step)))

    def _start(self, pose: Pose, now_ns: int) -> tuple[float, float]:
        """Return the yaw to go on from, and how far it may go by now."""
        heading = heading_rad(pose.q_ned_from_body)
        since_ns = now_ns - self._at_ns
        start = heading
        if since_ns <= _COMMAND_RECENT_NS:
            lead = wrap_rad(self._yaw_rad - heading)
            start += max(-_MAX_YAW_LEAD_RAD, min(_MAX_YAW_LEAD_RAD, lead))
        # A planner of 1-2 Hz is slow, not new: it turns too. After a longer pause the first step is none.
        paused = since_ns > self._paused_after_s * 1e9
        dt_s = 0.0 if paused else min(since_ns / 1e9, _MAX_SLEW_DT_S)
        return start, self._rate_rad_s * dt_s


class Command:
    """Turns the state into a decision on one setpoint.

    Parameters
    ----------
    config
        Limits and distances.
    evidence, plan, table
        What is known, what is being done, and what the situation asks for.
    camera_yaw_rad
        Azimuth of the camera's axis relative to the body's forward axis (its mounting).
    """

    def __init__(
        self,
        config: GuidanceConfig,
        evidence: Evidence,
        plan: Plan,
        table: Table,
        *,
        camera_yaw_rad: float,
    ) -> None:
        self._config = config
        self._evidence = evidence
        self._plan = plan
        self._table = table
        self._camera_yaw_rad = camera_yaw_rad
        self.yaw = YawSlew(config)

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take other limits from the next setpoint on."""
        self._config = config
        self.yaw.set_limits(config)

    def act(self, state: State, s: Situation) -> Decision:
        """Return what is sent in a state (any but DISENGAGED)."""
        plan = self._plan
        if state is State.FOLLOW:
            return self._follow(s)
        if state is State.STEER and s.gap is not None:
            psi, room_m = self._evidence.steered(s)
            longest_m = min(s.gap.left_m(s.pose), _longest_beside(room_m))
            return self._steer(s, psi, self._evidence.free_m(psi, s.pose, s.now_ns), longest_m)
        if state is State.STEER and s.answer is not None:
            psi, _ = self._evidence.steered(s)
            return self._steer(s, psi, self._evidence.void_free_m(s.answer, s))
        if state is State.PROBE:
            here_m = plan.probe_down_m
            return self._rewrite(*plan.probe_target, plan.probe_yaw_rad, "substituted", s, down_m=here_m)
        if plan.anchor is None:
            plan.set_anchor(s.pose)
        x, y = plan.anchor or (s.pose.north_m, s.pose.east_m)
        down_m = plan.anchor_down_m
        if state is State.ALIGN:
            return self._rewrite(x, y, s.bearing_rad - self._camera_yaw_rad, "turned", s, down_m=down_m)
        if state is State.TURN:
            plan.anchor_yaw_rad = wrap_rad(plan.turn_target_rad - self._camera_yaw_rad)
            return self._rewrite(x, y, plan.anchor_yaw_rad, "turned", s, down_m=down_m)
        return self._rewrite(x, y, plan.anchor_yaw_rad, "held", s, down_m=down_m)

    def hold_blindly(self, now_ns: int) -> Decision | None:
        """Return a hold at the anchor, whatever the pose is now; None without an anchor."""
        if self._plan.anchor is None:
            return None
        self.yaw.commanded(self._plan.anchor_yaw_rad, now_ns)
        return Rewrite(*self._plan.anchor, self._plan.anchor_yaw_rad, "held", self._plan.anchor_down_m)

    def _steer(self, s: Situation, psi: float, free_m: float | None, longest_m: float = math.inf) -> Decision:
        step_m = min(self._step_m(s.goal_m, free_m), longest_m, self._evidence.ways.reach_m(psi, s.pose))
        out_of_sight = abs(wrap_rad(psi - s.look_rad)) > math.radians(self._config.align_deg)
        if out_of_sight or self._table.choose(s)[1] == LOOK_AGAIN:
            # The camera must look where it flies, and no way is open before it is seen again.
            step_m = 0.0
        x, y = s.pose.north_m + step_m * math.cos(psi), s.pose.east_m + step_m * math.sin(psi)
        down_m = None if step_m > 0.0 else s.pose.down_m
        return self._rewrite(x, y, psi - self._camera_yaw_rad, "substituted", s, down_m=down_m)

    def _follow(self, s: Situation) -> Decision:
        wish = s.wish
        wanted_yaw: float | None
        if s.reached:
            step_m, wanted_yaw = min(s.goal_m, self._config.max_step_m), wish.yaw_rad
        else:
            _, room_m = self._evidence.seen.clearer(s.bearing_rad, s.pose, s.now_ns)
            step_m = min(
                self._step_m(s.goal_m, self._free_to_goal_m(s)),
                _longest_beside(room_m),
                self._evidence.ways.reach_m(s.bearing_rad, s.pose),
            )
            if self._table.choose(s)[1] == LOOK_AGAIN:
                step_m = 0.0
            wanted_yaw = s.bearing_rad - self._camera_yaw_rad
            if wish.yaw_rad is not None:
                off_bearing = wrap_rad(wish.yaw_rad + self._camera_yaw_rad - s.bearing_rad)
                if abs(off_bearing) <= math.radians(self._config.view_deg):
                    wanted_yaw = wish.yaw_rad
        whole_step = step_m >= s.goal_m
        slewed = None if wanted_yaw is None else self.yaw.toward(wanted_yaw, s.pose, s.now_ns)
        if self._steers_by_rate(s) and wish.yaw_rate_rad_s is not None:
            wanted_yaw = slewed = self.yaw.turning(wish.yaw_rate_rad_s, s.pose, s.now_ns)
        if whole_step and self._may_pass(s, slewed):
            passes = heading_rad(s.pose.q_ned_from_body) if wish.yaw_rad is None else wish.yaw_rad
            self.yaw.commanded(passes, s.now_ns)
            return Forward()
        if whole_step:
            x, y = s.goal
        else:
            x = s.pose.north_m + step_m * math.cos(s.bearing_rad)
            y = s.pose.east_m + step_m * math.sin(s.bearing_rad)
        down_m = None if s.reached or step_m > 0.0 else s.pose.down_m
        return self._rewrite(x, y, wanted_yaw, "substituted", s, down_m=down_m, slewed=slewed)

    def _steers_by_rate(self, s: Situation) -> bool:
        """Whether the planner turns the vehicle by a yaw rate: on the spot, or a goal that turns along."""
        if s.wish.yaw_rad is not None or s.wish.yaw_rate_rad_s is None:
            return False
        return s.reached or s.wish.body_bearing_rad is not None

    def _free_to_goal_m(self, s: Situation) -> float | None:
        """Return the free distance toward the goal, where anything is known of it."""
        free_m = s.free_bearing_m
        if s.answer is not None and s.answer.is_plane:
            plane_m = remaining_m(s.answer.report, s.pose)
            return plane_m if free_m is None else min(free_m, plane_m)
        if s.answer is not None and free_m is None:
            return self._evidence.void_free_m(s.answer, s)  # the void agrees: the next best that is known
        return free_m

    def _may_pass(self, s: Situation, slewed: float | None) -> bool:
        """Whether a setpoint whose whole step is granted may pass byte for byte, its yaw and further terms included."""
        wish = s.wish
        if s.reached and wish.yaw_rad is None:  # hover, with or without a slow yaw rate
            return self._is_calm(wish)
        if wish.yaw_rad is None or slewed is None or wish.carries or wish.yaw_rate_rad_s is not None:
            return False
        return abs(wrap_rad(slewed - wish.yaw_rad)) < 1e-6

    def _is_calm(self, wish: Wish) -> bool:
        """Whether the further terms of a setpoint at the goal cannot carry the vehicle away, nor spin it."""
        rate_rad_s = 0.0 if wish.yaw_rate_rad_s is None else wish.yaw_rate_rad_s
        return not wish.carries and abs(rate_rad_s) <= math.radians(self._config.yaw_rate_deg_s)

    def _step_m(self, goal_m: float, free_m: float | None) -> float:
        step_m = min(goal_m, self._config.max_step_m)
        if free_m is not None:
            step_m = min(step_m, free_m - self._config.step_margin_m)
        return max(0.0, step_m)

    def _rewrite(
        self,
        x: float,
        y: float,
        yaw_rad: float | None,
        action: str,
        s: Situation,
        *,
        down_m: float | None,
        slewed: float | None = None,
    ) -> Rewrite:
        if yaw_rad is None:
            return Rewrite(x, y, None, action, down_m)
        yaw = self.yaw.toward(yaw_rad, s.pose, s.now_ns) if slewed is None else slewed
        self.yaw.commanded(yaw, s.now_ns)
        return Rewrite(x, y, yaw, action, down_m)


def _longest_beside(room_m: float) -> float:
    """Return the longest step where something is remembered this near beside the way: slow past a corner or a jamb."""
    if room_m >= _ROOMY_M:
        return math.inf
    return max(_LEAST_STEP_M, _STEP_PER_ROOM * (room_m - _NO_ROOM_M))
