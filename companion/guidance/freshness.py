"""How long a detection is good for (a static scene: until the vehicle has moved, turned, or time has passed)."""

from __future__ import annotations

import math

from companion.config import GuidanceConfig
from companion.guidance.coordinates import heading_rad, wrap_rad
from companion.guidance.observation import DetectionReport, Pose


def expiry(
    report: DetectionReport, pose: Pose, speed_m_s: float, now_ns: int, limits: GuidanceConfig
) -> str | None:
    """Return why a report's answer may no longer be used, or None while it is good.

    The paper runs the detector once per m metres flown in a static scene (section 3). An answer here is
    good until the vehicle has moved ``redetect_distance_m`` or turned ``redetect_yaw_deg`` since its
    frame, or it is older than ``detection_max_age_s`` (moving) or ``detection_max_age_hover_s`` (at rest).

    Parameters
    ----------
    report
        The answer; one without a pose is never good.
    pose
        Where the vehicle is now.
    speed_m_s
        Horizontal speed now.
    now_ns
        Our monotonic time.
    limits
        The configured limits.
    """
    if report.pose is None:
        return "no pose at the frame's time"
    age_s = (now_ns - report.frame_ns) / 1e9
    if age_s < -0.1:
        return "from the future"
    moving = speed_m_s > limits.moving_m_s
    max_age_s = limits.detection_max_age_s if moving else limits.detection_max_age_hover_s
    if age_s > max_age_s:
        return f"{age_s:.1f} s old"
    moved_m = math.hypot(pose.north_m - report.pose.north_m, pose.east_m - report.pose.east_m)
    if moved_m > limits.redetect_distance_m:
        return f"moved {moved_m:.1f} m"
    turned = abs(wrap_rad(heading_rad(pose.q_ned_from_body) - heading_rad(report.pose.q_ned_from_body)))
    if math.degrees(turned) > limits.redetect_yaw_deg:
        return f"turned {math.degrees(turned):.0f} deg"
    return None
