"""A gap seen on the way to the goal, kept as a place to fly to until it is reached, contradicted or old.

The detector's direction says where it is emptiest, pair by pair; the free distances by bearing say how far the vehicle
would get. A doorway is best seen from afar: near its frame the camera sees no more than the frame. So the far end
of the best gap is kept as a place in local NED, and each report that sees it again renews it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from companion.guidance.coordinates import wrap_rad
from companion.guidance.observation import BearingRange, DetectionReport, Pose

Place = tuple[float, float]
"""North and east in local NED, m."""

_STEP_RAD = math.radians(4.5)
"""Bearings further apart than this are not neighbours: between them it is unknown."""
_PLATEAU = 0.8
"""Bearings beside the best one that are free for this share of it belong to the same gap."""
_FAR_M = 8.0
"""Ranges beyond this are too uncertain to prefer one to another."""
_SAME_RAD = math.radians(12.0)
"""A gap seen again within this angle of the kept one is the same gap."""
_SIGHTINGS = 2
"""Reports that must have seen it: one alone may have followed a wrong point."""
_ESTABLISHED = 4
"""Seen so often, a way is not shortened by a report that sees less far along it: near a door's frame one point beside the way hides it."""
_REACHED_M = 0.5
_CONTRADICTIONS = 2
_KEPT_NS = 12_000_000_000
_BETTER_M = 1.0
"""By how much another gap must bring the vehicle nearer to the goal to replace the kept one."""


def _nothing_remembered(_azimuth_rad: float) -> float | None:
    return None


@dataclass(frozen=True, slots=True)
class Gap:
    """A place that was measured to be reached in a straight line.

    Attributes
    ----------
    north_m, east_m
        Its end, the margin taken off, in local NED.
    worth_m
        What it is preferred by: how much nearer to the goal it leads, or how far it leads where the goal's way is blocked.
    sightings
        Reports that saw it.
    contradictions
        Reports in a row that measured its way to be blocked.
    seen_ns
        When it was last seen.
    """

    north_m: float
    east_m: float
    worth_m: float
    sightings: int
    contradictions: int
    seen_ns: int

    def azimuth_rad(self, pose: Pose) -> float:
        """Return the azimuth from the vehicle to its end."""
        return math.atan2(self.east_m - pose.east_m, self.north_m - pose.north_m)

    def left_m(self, pose: Pose) -> float:
        """Return the distance that is left to its end."""
        return math.hypot(self.north_m - pose.north_m, self.east_m - pose.east_m)

    def nearer_m(self, goal: Place, pose: Pose) -> float:
        """Return by how much its end is nearer to the goal than the vehicle is."""
        here_m = math.dist(goal, (pose.north_m, pose.east_m))
        return here_m - math.dist(goal, (self.north_m, self.east_m))


class Gaps:
    """Keeps the best gap that was seen.

    Parameters
    ----------
    margin_m
        Kept between its end and what stands there.
    least_m
        A gap leads at least this far.
    """

    def __init__(self, *, margin_m: float, least_m: float) -> None:
        self._margin_m = margin_m
        self._least_m = least_m
        self._kept: Gap | None = None

    def set_margin(self, margin_m: float) -> None:
        """Take another margin; the gap that is kept ends where it did."""
        self._margin_m = margin_m

    def forget(self) -> None:
        """Forget it."""
        self._kept = None

    def usable(self, pose: Pose, now_ns: int) -> Gap | None:
        """Return the gap, where it was seen often enough, is not reached and not too long ago."""
        gap = self._kept
        if gap is None:
            return None
        if now_ns - gap.seen_ns > _KEPT_NS or gap.left_m(pose) < _REACHED_M:
            self._kept = None
            return None
        return gap if gap.sightings >= _SIGHTINGS else None

    def add(
        self,
        report: DetectionReport,
        goal: Place,
        *,
        blocked: tuple[float, ...] = (),
        anywhere: bool = False,
        way_free_m: float | None = None,
        remembered_m: Callable[[float], float | None] = _nothing_remembered,
    ) -> None:
        """Take one report's bearings.

        Parameters
        ----------
        report
            With the pose of its frame.
        goal
            The planner's.
        blocked
            Azimuths (rad) of ways that were found blocked here: no gap is looked for there.
        anywhere
            Whether the way that leads furthest is wanted, also away from the goal.
        way_free_m
            What is measured free on the way to the kept gap from this report's pose, where it is known.
        remembered_m
            Says for an azimuth how far it is from this report's pose to what is remembered to stand there, None where nothing does.
        """
        pose = report.pose
        if pose is None:
            return
        kept = self._kept
        if kept is not None and way_free_m is not None:
            is_blocked = way_free_m < min(self._margin_m, kept.left_m(pose))
            count = kept.contradictions + 1 if is_blocked else 0
            kept = self._kept = None if count >= _CONTRADICTIONS else replace(kept, contradictions=count)
        best = best_gap(
            report.bearings,
            pose,
            goal,
            margin_m=self._margin_m,
            least_m=self._least_m,
            blocked=blocked,
            anywhere=anywhere,
            now_ns=report.frame_ns,
            remembered_m=remembered_m,
        )
        if best is None:
            return
        if kept is None:
            self._kept = best
            return
        turn_rad = abs(wrap_rad(best.azimuth_rad(pose) - kept.azimuth_rad(pose)))
        if turn_rad <= _SAME_RAD:
            if kept.sightings >= _ESTABLISHED and best.left_m(pose) < kept.left_m(pose) - _BETTER_M:
                return  # it is kept as it was, and grows old: one frame's edge is no end of a way that many saw through
            contradictions = kept.contradictions
            self._kept = replace(best, sightings=kept.sightings + 1, contradictions=contradictions)
        elif (
            kept.sightings < _SIGHTINGS
            or best.worth_m > self._worth_m(kept, goal, pose, anywhere) + _BETTER_M
        ):
            self._kept = best

    @staticmethod
    def _worth_m(gap: Gap, goal: Place, pose: Pose, anywhere: bool) -> float:
        return gap.left_m(pose) if anywhere else gap.nearer_m(goal, pose)


def best_gap(
    bearings: tuple[BearingRange, ...],
    pose: Pose,
    goal: Place,
    *,
    margin_m: float,
    least_m: float,
    blocked: tuple[float, ...],
    anywhere: bool,
    now_ns: int,
    remembered_m: Callable[[float], float | None] = _nothing_remembered,
) -> Gap | None:
    """Return the best of the ways that were measured from one place, or None.

    Each bearing is free for the whole vehicle's width already. The end of a way is ``margin_m`` before what stands there, and not
    beyond the goal's distance. The best one is the one whose end is nearest to the goal (``anywhere``: the longest), taken in the middle
    of the neighbouring bearings that are free nearly as far.

    Parameters
    ----------
    bearings
        Of one report.
    pose
        Of its frame.
    goal
        The planner's.
    margin_m, least_m
        Kept from what stands there; the least length of a way.
    blocked
        Azimuths (rad) that are not looked at.
    anywhere
        Whether any way will do, the longest first.
    now_ns
        Time of the frame.
    remembered_m
        Says for an azimuth how far it is to what is remembered to stand there, None where nothing does: a way that this
        report alone calls free is none, for the vehicle would not be let go along it.
    """
    goal_m = math.dist(goal, (pose.north_m, pose.east_m))
    ways: list[tuple[float, float, Gap]] = []
    for bearing in sorted(bearings, key=lambda b: b.azimuth_rad):
        free_m = min(bearing.distance_m - bearing.spread_m, _FAR_M)
        length_m = free_m - margin_m
        if length_m < least_m or any(
            abs(wrap_rad(bearing.azimuth_rad - b)) <= math.radians(15.0) for b in blocked
        ):
            continue
        stands_m = remembered_m(bearing.azimuth_rad)
        if stands_m is not None:
            length_m = min(length_m, stands_m - margin_m)
            if length_m < least_m:
                continue
        if not anywhere:
            length_m = min(length_m, goal_m)
        gap = Gap(
            pose.north_m + length_m * math.cos(bearing.azimuth_rad),
            pose.east_m + length_m * math.sin(bearing.azimuth_rad),
            0.0,
            1,
            0,
            now_ns,
        )
        worth_m = length_m if anywhere else gap.nearer_m(goal, pose)
        ways.append((bearing.azimuth_rad, length_m, replace(gap, worth_m=worth_m)))
    if not ways:
        return None
    at = max(range(len(ways)), key=lambda i: ways[i][2].worth_m)
    first = last = at
    enough_m = _PLATEAU * ways[at][1]

    def joins(one: int, other: int) -> bool:
        return ways[other][1] >= enough_m and abs(wrap_rad(ways[one][0] - ways[other][0])) <= _STEP_RAD

    while first > 0 and joins(first, first - 1):
        first -= 1
    while last < len(ways) - 1 and joins(last, last + 1):
        last += 1
    # A wide gap is entered near the best bearing, a narrow one in its middle.
    reach = min(at - first, last - at)
    middle = at if reach >= 2 else (first + last) // 2
    return ways[middle][2]
