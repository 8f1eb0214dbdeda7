"""What the switch S remembers of the world: bearings seen free, the track just flown, bearings found blocked."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from companion.config import GuidanceConfig
from companion.guidance.coordinates import wrap_rad
from companion.guidance.freshness import expiry
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.guidance.obstacles import NearObstacles

_BIN_RAD = math.radians(3.0)
_TRACK_GAP_M = 1.0
"""Two positions in a row further apart than this: what lies between was not seen to be flown."""
_REMEMBERED_SHARE = 1.0
"""Of the vehicle's width with its margins: less of the margin beside what was already passed."""
_ANOTHER_PLACE_M = 1.0
_SAME_RAD = math.radians(2.0)
"""A bearing is free for the vehicle's whole width; what it says of directions this close to it is good to 4 cm at a metre."""
_MATCH_RAD = math.radians(4.0)
"""Where no bearing is that near, those this close stand for it (half the vehicle's width at 5 m)."""


class SeenBearings:
    """Free distances by azimuth, as measured lately, less what is remembered to stand in the way.

    An azimuth not in here is unknown, not free.

    Parameters
    ----------
    limits
        How long a measurement is good for.
    vehicle_width_m
        What must fit between remembered obstacles, margins included.
    """

    def __init__(self, limits: GuidanceConfig, vehicle_width_m: float) -> None:
        self._near = NearObstacles(_REMEMBERED_SHARE * vehicle_width_m / 2)
        self.set_limits(limits)
        self._by_bin: dict[int, tuple[BearingRange, DetectionReport]] = {}

    def set_limits(self, limits: GuidanceConfig) -> None:
        """Take other limits: they count for what was measured before, too."""
        # A bearing is a direction in the world: turning the vehicle does not make it worse, so only the
        # limits on distance and age count here.
        self._limits = limits.model_copy(update={"redetect_yaw_deg": 180.0})

    def clear(self) -> None:
        """Forget everything."""
        self._by_bin.clear()
        self._near.clear()

    def forget_ranges(self) -> None:
        """Forget what was measured free; what was seen to stand somewhere is still taken to stand there."""
        self._by_bin.clear()

    def is_measured(self, azimuth_rad: float, pose: Pose, speed_m_s: float, now_ns: int) -> bool:
        """Whether an azimuth was measured lately; a remembered obstacle alone says nothing of the way to it."""
        return any(
            abs(wrap_rad(bearing.azimuth_rad - azimuth_rad)) <= _MATCH_RAD
            for bearing, _ in self._fresh(pose, speed_m_s, now_ns)
        )

    def add(self, report: DetectionReport) -> None:
        """Take the bearings and obstacles of one report; a newer measurement replaces the older one of its azimuth."""
        if report.pose is None:
            return
        self._near.add(report)
        for bearing in report.bearings:
            self._by_bin[round(bearing.azimuth_rad / _BIN_RAD)] = (bearing, report)

    def free_m(self, azimuth_rad: float, pose: Pose, speed_m_s: float, now_ns: int) -> float | None:
        """Return the free distance from the vehicle along an azimuth, or None where it is not known.

        The least of the fresh measurements within 2 degrees (where there is none, within 4), less their spread and less the
        way flown along the azimuth since; not beyond a remembered obstacle.
        """
        off = [
            (abs(wrap_rad(bearing.azimuth_rad - azimuth_rad)), bearing, report)
            for bearing, report in self._fresh(pose, speed_m_s, now_ns)
        ]
        near_rad = _SAME_RAD if any(off_rad <= _SAME_RAD for off_rad, _, _ in off) else _MATCH_RAD
        known_m = [
            _remaining_m(bearing, report, pose) for off_rad, bearing, report in off if off_rad <= near_rad
        ]
        remembered_m = self.remembered_m(azimuth_rad, pose, now_ns)
        if remembered_m is not None:
            known_m.append(remembered_m)
        return min(known_m, default=None)

    def remembered_m(self, azimuth_rad: float, pose: Pose, now_ns: int) -> float | None:
        """Return how far it is along an azimuth to what is remembered to stand there; None where nothing does."""
        return self._near.free_m(azimuth_rad, pose, now_ns)

    def clearer(self, azimuth_rad: float, pose: Pose, now_ns: int) -> tuple[float, float]:
        """Return the azimuth near a wanted one with most room beside what is remembered, and that room (m)."""
        return self._near.clearer(azimuth_rad, pose, now_ns)

    def free_azimuths(
        self, at_least_m: float, pose: Pose, speed_m_s: float, now_ns: int
    ) -> list[tuple[float, float]]:
        """Return (azimuth_rad, free distance in m) of all bearings known free that far, neighbours included."""
        fresh = [
            (bearing.azimuth_rad, _remaining_m(bearing, report, pose))
            for bearing, report in self._fresh(pose, speed_m_s, now_ns)
        ]
        remembered = {azimuth: self._near.free_m(azimuth, pose, now_ns) for azimuth, _ in fresh}
        fresh = [(a, m if (near_m := remembered[a]) is None else min(m, near_m)) for a, m in fresh]
        free = [
            (azimuth, min(m for other, m in fresh if abs(wrap_rad(other - azimuth)) <= _MATCH_RAD))
            for azimuth, _ in fresh
        ]
        return [(azimuth, free_m) for azimuth, free_m in free if free_m >= at_least_m]

    def _fresh(self, pose: Pose, speed_m_s: float, now_ns: int) -> list[tuple[BearingRange, DetectionReport]]:
        reports = {id(report): report for _, report in self._by_bin.values()}
        good = {
            key
            for key, report in reports.items()
            if not expiry(report, pose, speed_m_s, now_ns, self._limits)
        }
        return [(bearing, report) for bearing, report in self._by_bin.values() if id(report) in good]


def _remaining_m(bearing: BearingRange, report: DetectionReport, pose: Pose) -> float:
    origin = report.pose
    if origin is None:  # add() keeps no report without a pose
        return 0.0
    flown_m = (pose.north_m - origin.north_m) * math.cos(bearing.azimuth_rad) + (
        pose.east_m - origin.east_m
    ) * math.sin(bearing.azimuth_rad)
    return max(0.0, bearing.distance_m - bearing.spread_m - flown_m)


class Track:
    """The horizontal track just flown: where the vehicle has been is free."""

    def __init__(self, *, spacing_m: float = 0.1, length_m: float = 5.0) -> None:
        self._spacing_m = spacing_m
        self._points: deque[tuple[float, float]] = deque(maxlen=max(2, round(length_m / spacing_m)))

    def clear(self) -> None:
        """Forget the track (estimator reset, mode left)."""
        self._points.clear()

    def add(self, north_m: float, east_m: float) -> None:
        """Take the vehicle's position; after a gap the track begins anew."""
        if self._points and math.dist(self._points[-1], (north_m, east_m)) > _TRACK_GAP_M:
            self._points.clear()
        if not self._points or math.dist(self._points[-1], (north_m, east_m)) >= self._spacing_m:
            self._points.append((north_m, east_m))

    def back(self, north_m: float, east_m: float, distance_m: float) -> tuple[float, float] | None:
        """Return the latest point of the track at least ``distance_m`` from here, or None."""
        for point in reversed(self._points):
            if math.dist(point, (north_m, east_m)) >= distance_m:
                return point
        return None


@dataclass(frozen=True, slots=True)
class _Blocked:
    azimuth_rad: float
    north_m: float
    east_m: float


class Episode:
    """One avoidance: the side of its turns, how far they have swept, and what was found blocked or probed.

    It ends after ``episode_distance_m`` from where it began, or on a new goal.
    """

    def __init__(self, north_m: float, east_m: float) -> None:
        self.north_m = north_m
        self.east_m = east_m
        self.side: int = 0
        self.sweep_rad = 0.0
        self._turned_at: tuple[float, float] | None = None
        self._blocked: list[_Blocked] = []
        self._bootstrapped_rad: list[float] = []

    def over(self, pose: Pose, distance_m: float) -> bool:
        """Whether the vehicle has left the place of this episode."""
        return math.dist((self.north_m, self.east_m), (pose.north_m, pose.east_m)) > distance_m

    def begin_turn(self, pose: Pose) -> bool:
        """Take note of where a turn begins; return whether its side is still to be chosen.

        Turns at one place keep their side and add up. Another place is another view.
        """
        here = (pose.north_m, pose.east_m)
        if self._turned_at is None or math.dist(self._turned_at, here) > _ANOTHER_PLACE_M:
            self.side, self.sweep_rad = 0, 0.0
            self._turned_at = here
        return self.side == 0

    @property
    def has_turned(self) -> bool:
        """Whether a turn was begun in this episode."""
        return self._turned_at is not None

    def block(self, azimuth_rad: float, pose: Pose) -> None:
        """Remember a bearing that was found blocked here."""
        if not self.is_blocked(azimuth_rad):
            self._blocked.append(_Blocked(azimuth_rad, pose.north_m, pose.east_m))

    def is_blocked(self, azimuth_rad: float, within_rad: float = math.radians(15.0)) -> bool:
        """Whether a bearing close to this one was found blocked in this episode."""
        return any(abs(wrap_rad(b.azimuth_rad - azimuth_rad)) <= within_rad for b in self._blocked)

    @property
    def blocked_rad(self) -> tuple[float, ...]:
        """Azimuths that were found blocked in this episode."""
        return tuple(b.azimuth_rad for b in self._blocked)

    def bootstrap(self, look_rad: float) -> None:
        """Remember that a blind step was taken at this heading."""
        self._bootstrapped_rad.append(look_rad)

    def forget_last_bootstrap(self) -> None:
        """Take back the last blind step: it was not made."""
        if self._bootstrapped_rad:
            self._bootstrapped_rad.pop()

    def was_bootstrapped(self, look_rad: float, within_rad: float) -> bool:
        """Whether a blind step was taken close to this heading in this episode."""
        return any(abs(wrap_rad(b - look_rad)) < within_rad for b in self._bootstrapped_rad)
