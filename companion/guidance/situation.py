"""What is true now: all that came in, each with its time, put together into what one decision looks at.

Nothing here decides. `Evidence` keeps the newest pose, the answers of the detector and what is remembered of the
world, and drops what may no longer be used; `Situation` is what it means for one setpoint of the planner.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from companion.config import GuidanceConfig
from companion.guidance.coordinates import azimuth_of_body_ray, heading_rad, wrap_rad
from companion.guidance.freshness import expiry
from companion.guidance.gaps import Gap, Gaps
from companion.guidance.goal import Goal
from companion.guidance.memory import SeenBearings, Track
from companion.guidance.observation import DetectionReport, Pose
from companion.guidance.swept import SeenWays
from companion.guidance.wish import Wish

_NO_PARALLAX = ("no_motion", "no_earlier_frame")
"""Reasons of the detector that say nothing about the scene: the last answer stays and ages."""
_UNSURE = "low_confidence"
_MIN_STEP_M = 0.2
"""A way that is not free for this much (beyond the margin) is blocked."""
_MIN_GAP_M = 1.2
"""A way that leads less far beyond its margin is no gap to fly to."""
_DETOUR_M = 0.7
"""A gap is flown to where it leads nearer to the goal than the straight way by more than this."""
_ARRIVED_FACTOR = 1.5
"""Once arrived, the goal stays reached up to this many arrival radii: a hovering vehicle wanders."""
_FUTURE_NS = 100_000_000
"""A report about a frame further ahead of our time than this is refused: its clock is not ours."""
_PAIR_AGE_NS = 4_000_000_000
"""Where a report does not name its earlier frame, that frame may be this much older than the later one."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A direction that the detector gave, or the way up to a plane too far away to be a wall yet.

    Attributes
    ----------
    report
        Where it comes from.
    azimuth_rad
        Local NED.
    is_plane
        Whether it is the way up to a plane.
    """

    report: DetectionReport
    azimuth_rad: float
    is_plane: bool


@dataclass(frozen=True, slots=True)
class Situation:
    """All that one decision looks at.

    Attributes
    ----------
    now_ns
        Our monotonic time.
    wish
        What the planner asks for.
    pose, speed_m_s
        The vehicle's.
    look_rad
        Azimuth of the camera's axis.
    goal
        The planner's: north and east, m.
    bearing_rad, goal_m
        Azimuth and horizontal distance from the vehicle to it.
    wants_to_move
        The planner wants to get somewhere.
    reached
        The goal has been stationary for a while and is near, with nothing nearer.
    off_axis_rad
        Angle between the camera's axis and the bearing, not negative.
    answer, no_answer
        The direction that may be used, or why there is none.
    wall
        What stands in the way, where enough answers say so.
    free_bearing_m
        Free distance known along the bearing.
    gap
        A way seen lately that leads further than the goal's bearing, where there is one.
    """

    now_ns: int
    wish: Wish
    pose: Pose
    speed_m_s: float
    look_rad: float
    goal: tuple[float, float]
    bearing_rad: float
    goal_m: float
    wants_to_move: bool
    reached: bool
    off_axis_rad: float
    answer: Answer | None
    no_answer: str
    wall: str | None
    free_bearing_m: float | None
    gap: Gap | None = None


class Evidence:
    """What came in and is remembered; each value is judged by its age when it is used.

    Parameters
    ----------
    config
        Limits and distances.
    camera_yaw_rad
        Azimuth of the camera's axis relative to the body's forward axis (its mounting).
    vehicle_width_m
        With margins: what must fit between remembered obstacles.
    """

    def __init__(self, config: GuidanceConfig, *, camera_yaw_rad: float, vehicle_width_m: float) -> None:
        self._config = config
        self._camera_yaw_rad = camera_yaw_rad
        self.pose: Pose | None = None
        self.speed_m_s = 0.0
        self.goal = Goal(config)
        self.answer: Answer | None = None
        self.last_report: DetectionReport | None = None
        self.last_report_ns: int | None = None
        self.newest_frame_ns = -(1 << 62)
        self.votes: deque[DetectionReport | None] = deque(maxlen=config.wall_n)
        self.seen = SeenBearings(config, vehicle_width_m)
        self.ways = SeenWays()
        self.track = Track()
        self.gaps = Gaps(margin_m=config.step_margin_m, least_m=_MIN_GAP_M)
        self.blocked: tuple[float, ...] = ()
        self._bad_reports = 0
        self._blind_reports = 0
        self._answers_after_ns = -(1 << 62)
        self._pairs_after_ns = -(1 << 62)
        self._arrived = False

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take other limits: what is known stays, and is judged by them."""
        self._config = config
        self.goal.set_limits(config)
        self.seen.set_limits(config)
        self.gaps.set_margin(config.step_margin_m)
        if config.wall_n != self.votes.maxlen:
            self.votes = deque(self.votes, maxlen=config.wall_n)

    # ------------------------------------------------------------------ what comes in

    def on_pose(self, pose: Pose, speed_m_s: float) -> None:
        """Take the vehicle's newest pose and horizontal speed."""
        self.pose = pose
        self.speed_m_s = speed_m_s
        self.track.add(pose.north_m, pose.east_m)

    def on_report(self, report: DetectionReport, now_ns: int) -> None:
        """Take one report of the vision worker; one about an older frame than the last is ignored.

        So is one about a frame of the future: it would make all later ones look old.
        """
        if report.frame_ns <= self.newest_frame_ns or report.frame_ns > now_ns + _FUTURE_NS:
            return
        self.newest_frame_ns = report.frame_ns
        report = _believed(report, self._config.min_confidence)
        self.last_report_ns = now_ns
        self.last_report = report
        self.ways.add(report)
        is_of_this_frame = (
            _pair_began_ns(report) >= self._pairs_after_ns
        )  # else the way flown in it is not known
        if report.pose is not None and report.frame_ns >= self._answers_after_ns and is_of_this_frame:
            # Ranges stand for themselves: they may be known where the picture has too little for a direction.
            self.seen.add(report)
            self._note_gaps(report, now_ns)
        if report.bearings:
            self._blind_reports = 0
        elif report.kind != "none" or report.reason not in _NO_PARALLAX:
            self._blind_reports += 1
        if report.kind == "none":
            if report.reason not in _NO_PARALLAX:
                self._bad_reports += 1
                if self._bad_reports >= self._config.bad_reports_to_hold:
                    self.answer = None
            return
        if report.frame_ns < self._answers_after_ns or report.pose is None or not is_of_this_frame:
            return
        self._bad_reports = 0
        if report.kind == "single_plane":
            self.votes.append(report)
            if report.distance_m is not None and report.distance_m > self._wall_range_m(math.inf):
                self.answer = Answer(report, self.look_rad(report.pose), is_plane=True)
            return
        if report.ray_body is None:
            return
        azimuth = azimuth_of_body_ray(report.ray_body, report.pose.q_ned_from_body)
        if azimuth is None:
            return
        self.answer = Answer(report, azimuth, is_plane=False)
        self.votes.append(report if self._is_boxed_in(azimuth, now_ns) else None)

    def _note_gaps(self, report: DetectionReport, now_ns: int) -> None:
        pose, goal = report.pose, self.goal.position
        if pose is None or goal is None:
            return
        kept = self.gaps.usable(pose, now_ns)
        way_free_m = None
        if kept is not None:
            way_free_m = self.seen.free_m(kept.azimuth_rad(pose), pose, self.speed_m_s, now_ns)
        self.gaps.add(
            report,
            goal,
            blocked=self.blocked,
            anywhere=bool(self.blocked),
            way_free_m=way_free_m,
            remembered_m=lambda azimuth: self.seen.remembered_m(azimuth, pose, now_ns),
        )

    # ------------------------------------------------------------------ what is forgotten

    def take_answers_after(self, now_ns: int) -> None:
        """Forget the last answer and the votes: those from before this moment say nothing of what comes."""
        self.answer = None
        self.votes.clear()
        self._answers_after_ns = now_ns

    def drop_measurements(self, now_ns: int) -> None:
        """Forget what was measured free; what was seen to stand somewhere nearby still counts."""
        self.take_answers_after(now_ns)
        self.seen.forget_ranges()
        self.gaps.forget()

    def drop_local_frame(self, now_ns: int) -> None:
        """Forget all that was measured in a local frame that is no longer (estimator reset)."""
        self.pose = None
        self.drop_measurements(now_ns)
        self._pairs_after_ns = now_ns
        self.seen.clear()
        self.ways.clear()
        self.track.clear()
        self._arrived = False

    def forget_flight(self) -> None:
        """Forget all but the pose: the mode was left."""
        self.answer = None
        self.votes.clear()
        self.seen.clear()
        self.ways.clear()
        self.gaps.forget()
        self.track.clear()
        self.goal.forget()
        self._arrived = False

    # ------------------------------------------------------------------ what it means

    def look_rad(self, pose: Pose) -> float:
        """Return the azimuth of the camera's axis."""
        return wrap_rad(heading_rad(pose.q_ned_from_body) + self._camera_yaw_rad)

    def says_no_texture(self) -> bool:
        """Whether the last picture could not be used, for another reason than lack of motion."""
        last = self.last_report
        if last is None or last.reason == _UNSURE:
            return False  # another look, from a little further on, is what makes it sure
        return last.kind == "none" and last.reason not in _NO_PARALLAX

    def lacks_parallax(self) -> bool:
        """Whether the last picture said nothing for want of motion."""
        last = self.last_report
        return last is not None and last.kind == "none" and last.reason in _NO_PARALLAX

    def sees_ranges(self) -> bool:
        """Whether the last pictures told distances: without, what was measured before is not gone by for long."""
        return self._blind_reports < self._config.bad_reports_to_hold

    def situation(self, wish: Wish, goal: tuple[float, float], pose: Pose, now_ns: int) -> Situation:
        """Return what is true now for one setpoint of the planner, whose goal is known."""
        config = self._config
        to_north, to_east = goal[0] - pose.north_m, goal[1] - pose.east_m
        goal_m = math.hypot(to_north, to_east)
        look = self.look_rad(pose)
        bearing = math.atan2(to_east, to_north) if goal_m > 1e-6 else look
        answer, no_answer = self._good_answer(pose, now_ns)
        wall = self._wall(goal_m, pose, now_ns)
        free_bearing_m = self.free_m(bearing, pose, now_ns)
        radius_m = config.arrive_radius_m * (_ARRIVED_FACTOR if self._arrived else 1.0)
        nothing_nearer = wall is None and (free_bearing_m is None or free_bearing_m >= goal_m)
        settled = goal_m <= radius_m and self.goal.still_s(now_ns) >= config.goal_settle_s
        # A goal that moves with the vehicle is never arrived at: it is only ever to stay, or to go on.
        arrived = wish.asks_to_stay(goal_m) if wish.is_relative else settled
        reached = arrived and nothing_nearer
        self._arrived = reached
        return Situation(
            now_ns=now_ns,
            wish=wish,
            pose=pose,
            speed_m_s=self.speed_m_s,
            look_rad=look,
            goal=goal,
            bearing_rad=bearing,
            goal_m=goal_m,
            wants_to_move=wish.wants_to_move(goal_m, config.arrive_radius_m),
            reached=reached,
            off_axis_rad=abs(wrap_rad(bearing - look)),
            answer=answer,
            no_answer=no_answer,
            wall=wall,
            free_bearing_m=free_bearing_m,
            gap=self._better_gap(goal, goal_m, free_bearing_m, pose, now_ns),
        )

    def _better_gap(
        self, goal: tuple[float, float], goal_m: float, free_m: float | None, pose: Pose, now_ns: int
    ) -> Gap | None:
        """Return the gap kept, where it leads further than the goal's own bearing."""
        gap = self.gaps.usable(pose, now_ns) if self.sees_ranges() else None
        if gap is None or self.blocked or free_m is None:
            return gap
        straight_m = min(goal_m, max(0.0, free_m - self._config.step_margin_m))
        return gap if gap.nearer_m(goal, pose) > straight_m + _DETOUR_M else None

    def free_m(self, azimuth_rad: float, pose: Pose, now_ns: int) -> float | None:
        """Return the free distance known along an azimuth, or None."""
        return self.seen.free_m(azimuth_rad, pose, self.speed_m_s, now_ns)

    def steered(self, s: Situation) -> tuple[float, float]:
        """Return the azimuth that STEER flies along, and the room (m) beside it where that is a gap's, else infinite.

        The gap's azimuth, with room beside it, or the void's; as far as it was looked through.
        """
        wanted, room_m = s.bearing_rad, math.inf
        if s.gap is not None:
            wanted, room_m = self.seen.clearer(s.gap.azimuth_rad(s.pose), s.pose, s.now_ns)
        elif s.answer is not None:
            wanted = s.answer.azimuth_rad
        return self.ways.further(wanted, s.pose), room_m

    def void_free_m(self, answer: Answer, s: Situation) -> float | None:
        """Return what is known of the free distance along the answer's direction."""
        free_m = self.free_m(answer.azimuth_rad, s.pose, s.now_ns)
        if answer.is_plane:
            plane_m = remaining_m(answer.report, s.pose)
            free_m = plane_m if free_m is None else min(free_m, plane_m)
        return free_m

    def is_open(self, free_m: float | None, goal_m: float) -> bool:
        """Whether a way is not known to be blocked for the least step."""
        return free_m is None or free_m - self._config.step_margin_m >= min(goal_m, _MIN_STEP_M)

    def _good_answer(self, pose: Pose, now_ns: int) -> tuple[Answer | None, str]:
        if self.answer is None:
            last = self.last_report
            if last is not None and last.kind == "none":
                return None, last.reason
            return None, "no answer yet"
        why = expiry(self.answer.report, pose, self.speed_m_s, now_ns, self._config)
        return (self.answer, "") if why is None else (None, "last answer used up")

    def _wall_range_m(self, goal_m: float) -> float:
        return min(goal_m, self._config.wall_limit_m) + self._config.wall_margin_m

    def _wall(self, goal_m: float, pose: Pose, now_ns: int) -> str | None:
        """Return what stands in the way when enough of the last answers say so, else None."""
        limit_m = self._wall_range_m(goal_m)
        votes = 0
        boxed_in = 0
        for report in self.votes:
            if report is None or expiry(report, pose, self.speed_m_s, now_ns, self._config):
                continue
            if report.kind != "single_plane":
                boxed_in += 1
                continue
            if report.distance_m is None or remaining_m(report, pose) <= limit_m:
                votes += 1
        if votes + boxed_in < self._config.wall_k:
            return None
        return "wall ahead" if votes >= boxed_in else "no way ahead"

    def _is_boxed_in(self, void_rad: float, now_ns: int) -> bool:
        """Whether both the void and the goal's bearing are measured to be blocked at close range."""
        pose, goal = self.pose, self.goal.position
        if pose is None or goal is None:
            return False
        bearing = math.atan2(goal[1] - pose.east_m, goal[0] - pose.north_m)
        goal_m = math.hypot(goal[1] - pose.east_m, goal[0] - pose.north_m)
        return not self.is_open(self.free_m(void_rad, pose, now_ns), math.inf) and not self.is_open(
            self.free_m(bearing, pose, now_ns), goal_m
        )


def remaining_m(report: DetectionReport, pose: Pose) -> float:
    """Return the distance that is left of a report's own, after the way flown since; 0 where it is not known."""
    origin = report.pose
    if report.distance_m is None or origin is None:
        return 0.0
    moved_m = math.hypot(pose.north_m - origin.north_m, pose.east_m - origin.east_m)
    return report.distance_m - moved_m


def _believed(report: DetectionReport, min_confidence: float) -> DetectionReport:
    """Return a report without what it is not sure enough of; what it saw to stand nearby still counts."""
    if report.confidence is None or report.confidence >= min_confidence:
        return report
    detail = f"confidence {report.confidence:.2f}, at least {min_confidence:g} needed"
    return replace(
        report, kind="none", reason=_UNSURE, detail=detail, ray_body=None, distance_m=None, bearings=()
    )


def _pair_began_ns(report: DetectionReport) -> int:
    """Return when the earlier frame of a report's pair was exposed, at the earliest where it is not said."""
    if report.earlier_frame_ns is not None:
        return report.earlier_frame_ns
    return report.frame_ns - _PAIR_AGE_NS
