"""Ways along which the vehicle's disc can be moved through what was looked through, from the newest report that says so."""

from __future__ import annotations

import math

from companion.guidance.coordinates import wrap_rad
from companion.guidance.observation import DetectionReport, Pose

_ASTRAY_RAD = math.radians(3.0)
"""How far to either side of the line it is sent along a vehicle may drift, from its speed before."""
_LEAST_M = 0.25
"""A shorter way is none: the cells that were looked through are 0.1 m wide, and many small steps add up."""
_SIDESTEP_RAD = math.radians(3.0)
_SIDESTEPS = 7
_REACH_PER_RAD_M = 1.0
"""A deviation of one radian must lead this much further."""
_ENOUGH_M = 1.0
"""A way that was looked through for this long is as good as a longer one: the next report will say more."""


class SeenWays:
    """What the newest report says of how far the vehicle's whole width was looked through."""

    def __init__(self) -> None:
        self._report: DetectionReport | None = None

    def clear(self) -> None:
        """Forget it: the local frame is another one."""
        self._report = None

    def add(self, report: DetectionReport) -> None:
        """Take a report."""
        if report.pose is not None and report.swept_m:
            self._report = report

    def reach_m(self, azimuth_rad: float, pose: Pose) -> float:
        """Return how far the vehicle may go along an azimuth; infinite where the method does not say (``paper``)."""
        report = self._report
        if report is None or report.pose is None:
            return math.inf
        ways = len(report.swept_m)
        first = math.floor((azimuth_rad - _ASTRAY_RAD) / math.tau * ways)
        last = math.ceil((azimuth_rad + _ASTRAY_RAD) / math.tau * ways)
        reach_m = min(report.swept_m[way % ways] for way in range(first, last + 1))
        flown_m = (pose.north_m - report.pose.north_m) * math.cos(azimuth_rad) + (
            pose.east_m - report.pose.east_m
        ) * math.sin(azimuth_rad)
        left_m = reach_m - flown_m
        return left_m if left_m >= _LEAST_M else 0.0

    def further(self, azimuth_rad: float, pose: Pose) -> float:
        """Return the azimuth near a wanted one that was looked through clearly further."""

        def worth(azimuth: float) -> float:
            turn_rad = abs(wrap_rad(azimuth - azimuth_rad))
            return min(self.reach_m(azimuth, pose), _ENOUGH_M) - _REACH_PER_RAD_M * turn_rad

        if self.reach_m(azimuth_rad, pose) >= _ENOUGH_M:
            return azimuth_rad
        offers = [azimuth_rad + s * i * _SIDESTEP_RAD for i in range(_SIDESTEPS + 1) for s in (1, -1)]
        return max(offers, key=worth)
