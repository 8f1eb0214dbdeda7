"""A flat world for the switch S: walls as segments, a vehicle that follows setpoints, an ideal detector.

The detector here knows the geometry, but not more than a camera could: it answers only where it has moved far
enough between two frames at nearly the same heading, and only within its field of view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from companion.config import GuidanceConfig
from companion.guidance.coordinates import quaternion_from_euler, wrap_rad
from companion.guidance.dialect import Autopilot, Motion, Reading
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.guidance.setpoint import Decision, Drop, Forward, LocalSetpoint, Rewrite
from companion.guidance.substitution import GaveUp, State, StateChanged, Switch
from companion.guidance.wish import Wish, wish_of

SEC = 1_000_000_000
RADIUS_M = 0.35
HALF_VIEW = math.radians(35.0)
Wall = tuple[float, float, float, float]


def room(north: float, east: float, *, at: tuple[float, float] = (0.0, 0.0)) -> list[Wall]:
    """Four walls around ``at``."""
    n0, n1, e0, e1 = at[0] - north / 2, at[0] + north / 2, at[1] - east / 2, at[1] + east / 2
    return [(n0, e0, n0, e1), (n1, e0, n1, e1), (n0, e0, n1, e0), (n0, e1, n1, e1)]


def setpoint(
    x: float, y: float, z: float = -1.2, *, yaw: float | None = None, mask: int | None = None
) -> LocalSetpoint:
    if mask is None:
        mask = 3576 if yaw is None else 2552
    return LocalSetpoint(0, x, y, z, 0, 0, 0, 0, 0, 0, yaw or 0.0, 0, mask, 1, 1, 1)


def wish(goal: LocalSetpoint, config: GuidanceConfig | None = None) -> Wish:
    """What a position in LOCAL_NED asks for."""
    return wish_of(
        goal,
        Reading(Motion.POSITION),
        pose=None,
        anchor=None,
        autopilot=Autopilot.PX4,
        config=config or GuidanceConfig(),
    )


def _ray_hit(n: float, e: float, azimuth: float, walls: list[Wall]) -> tuple[float, int]:
    """Distance and index of the first wall along a ray."""
    dn, de = math.cos(azimuth), math.sin(azimuth)
    best, which = 60.0, -1
    for i, (n0, e0, n1, e1) in enumerate(walls):
        wn, we = n1 - n0, e1 - e0
        det = dn * (-we) - de * (-wn)
        if abs(det) < 1e-12:
            continue
        t = ((n0 - n) * (-we) - (e0 - e) * (-wn)) / det
        u = (dn * (e0 - e) - de * (n0 - n)) / det
        if 0 < t < best and 0 <= u <= 1:
            best, which = t, i
    return best, which


def swept_m(n: float, e: float, azimuth: float, walls: list[Wall]) -> float:
    """Free distance of a disc of the vehicle's radius along an azimuth."""
    dn, de = math.cos(azimuth), math.sin(azimuth)
    return min(
        _ray_hit(n - side * de, e + side * dn, azimuth, walls)[0] for side in (-RADIUS_M, 0.0, RADIUS_M)
    )


def clearance_m(n: float, e: float, walls: list[Wall]) -> float:
    """Distance from a point to the nearest wall."""
    best = math.inf
    for n0, e0, n1, e1 in walls:
        wn, we = n1 - n0, e1 - e0
        t = max(0.0, min(1.0, ((n - n0) * wn + (e - e0) * we) / (wn * wn + we * we)))
        best = min(best, math.dist((n, e), (n0 + t * wn, e0 + t * we)))
    return best


@dataclass
class Flight:
    """One flight: world, vehicle, ideal detector and the switch under test, stepped in simulated time."""

    walls: list[Wall]
    config: GuidanceConfig = field(default_factory=GuidanceConfig)
    n: float = 0.0
    e: float = 0.0
    d: float = -1.2
    yaw: float = 0.0
    camera_alive: bool = True
    poses_alive: bool = True
    texture: bool = True
    offboard: bool = True
    armed: bool = True

    def __post_init__(self) -> None:
        self.now = 10 * SEC
        self.switch = Switch(self.config)
        self.vn = self.ve = 0.0
        self.verdicts: list[tuple[int, Decision]] = []
        self.changes: list[StateChanged] = []
        self.gave_up: list[GaveUp] = []
        self.min_clearance = math.inf
        self.frames: list[tuple[int, float, float, float, float]] = []
        self.offset = (0.0, 0.0)  # of the estimate against the truth

    @property
    def state(self) -> State:
        return self.switch.state

    def states(self) -> list[str]:
        return [str(change.state) for change in self.changes]

    def pose(self) -> Pose:
        return Pose(
            self.now,
            self.n + self.offset[0],
            self.e + self.offset[1],
            self.d,
            quaternion_from_euler(0, 0, self.yaw),
        )

    def report(self) -> DetectionReport:
        """What an ideal detector would answer now."""
        self.frames = [f for f in self.frames if self.now - f[0] <= 3 * SEC]
        partner = next(
            (
                f
                for f in reversed(self.frames)
                if math.dist((f[1], f[2], f[4]), (self.n, self.e, self.d)) >= 0.1
                and abs(wrap_rad(f[3] - self.yaw)) < math.radians(15)
            ),
            None,
        )
        seq = len(self.verdicts)
        self.frames.append((self.now, self.n, self.e, self.yaw, self.d))
        if not self.texture:
            return DetectionReport(seq, self.now, "none", "too_few_features_later", pose=self.pose())
        if partner is None:
            return DetectionReport(seq, self.now, "none", "no_motion", pose=self.pose())
        azimuths = [wrap_rad(self.yaw + math.radians(a)) for a in range(-33, 34, 3)]
        hits = [_ray_hit(self.n, self.e, a, self.walls) for a in azimuths]
        free = [swept_m(self.n, self.e, a, self.walls) for a in azimuths]
        earlier_ns = partner[0]
        obstacles = tuple(
            (self.n + self.offset[0] + d * math.cos(a), self.e + self.offset[1] + d * math.sin(a))
            for a, (d, which) in zip(azimuths, hits, strict=True)
            if which >= 0 and d <= 3.0
        )
        bearings = tuple(BearingRange(a, f, 0.02 * f, 10) for a, f in zip(azimuths, free, strict=True))
        if len({which for _, which in hits}) == 1:
            ahead = _ray_hit(self.n, self.e, self.yaw, self.walls)[0]
            return DetectionReport(
                seq,
                self.now,
                "single_plane",
                pose=self.pose(),
                distance_m=ahead,
                bearings=bearings,
                obstacles=obstacles,
                earlier_frame_ns=earlier_ns,
            )
        # the middle of the plateau of the furthest free bearings
        best = max(free)
        plateau = [a for a, f in zip(azimuths, free, strict=True) if f >= 0.9 * best]
        body = wrap_rad(plateau[len(plateau) // 2] - self.yaw)
        return DetectionReport(
            seq,
            self.now,
            "lowest_flow",
            pose=self.pose(),
            ray_body=(math.cos(body), math.sin(body), 0.0),
            distance_m=best,
            bearings=bearings,
            obstacles=obstacles,
            earlier_frame_ns=earlier_ns,
        )

    def step(self, goal: LocalSetpoint | None, dt: float = 0.05) -> Decision | None:
        """One planner period: telemetry, a report every 0.2 s, one setpoint, then the vehicle moves."""
        self.sense(dt)
        verdict = None
        if goal is not None:
            verdict = self.switch.on_setpoint(wish(goal), self.now)
            self.verdicts.append((self.now, verdict))
            self._fly(goal, verdict, dt)
        self.note()
        return verdict

    def sense(self, dt: float) -> None:
        """What comes in within one planner period, before its setpoint."""
        self.now += round(dt * 1e9)
        self.switch.on_vehicle(armed=self.armed, offboard=self.offboard, now_ns=self.now)
        if self.poses_alive:
            self.switch.on_pose(self.pose(), math.hypot(self.vn, self.ve))
        if self.camera_alive and round(self.now / 1e9 / dt) % round(0.2 / dt) == 0:
            self.switch.on_report(self.report(), self.now)

    def note(self) -> None:
        """What the switch said, and how near the walls are."""
        for event in self.switch.drain_events():
            if isinstance(event, StateChanged):
                self.changes.append(event)
            else:
                self.gave_up.append(event)
        self.min_clearance = min(self.min_clearance, clearance_m(self.n, self.e, self.walls))

    def _fly(self, goal: LocalSetpoint, verdict: Decision, dt: float) -> None:
        if not (self.armed and self.offboard) or isinstance(verdict, Drop):
            self.vn = self.ve = 0.0
            return
        if isinstance(verdict, Forward):
            x, y = goal.x, goal.y
            yaw = None if goal.type_mask & 1024 else goal.yaw
        else:
            x, y, yaw = verdict.x, verdict.y, verdict.yaw
        x, y = x - self.offset[0], y - self.offset[1]
        wanted_n, wanted_e = 1.0 * (x - self.n), 1.0 * (y - self.e)
        speed = math.hypot(wanted_n, wanted_e)
        if speed > 1.0:
            wanted_n, wanted_e = wanted_n / speed, wanted_e / speed
        blend = min(1.0, dt / 0.3)
        self.vn += blend * (wanted_n - self.vn)
        self.ve += blend * (wanted_e - self.ve)
        self.n += self.vn * dt
        self.e += self.ve * dt
        self.d += max(-0.5 * dt, min(0.5 * dt, goal.z - self.d))
        if yaw is not None:
            turn = wrap_rad(yaw - self.yaw)
            self.yaw = wrap_rad(self.yaw + max(-2.3 * dt, min(2.3 * dt, turn)))

    def fly(self, goal: LocalSetpoint, seconds: float, *, until_m: float | None = None) -> bool:
        """Stream one goal; return whether it was reached within ``until_m``."""
        for _ in range(round(seconds / 0.05)):
            self.step(goal)
            if until_m is not None and math.dist((self.n, self.e), (goal.x, goal.y)) <= until_m:
                return True
        return False


def sent_xy(verdict: Decision, goal: LocalSetpoint) -> tuple[float, float] | None:
    """Where the autopilot is sent by a verdict."""
    if isinstance(verdict, Rewrite):
        return verdict.x, verdict.y
    return (goal.x, goal.y) if isinstance(verdict, Forward) else None
