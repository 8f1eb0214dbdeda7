"""A flat-world flight whose setpoints are of any kind, and whose vehicle flies what reaches the autopilot's side.

The frame that leaves is read by the simulated autopilot's own rules, which are written apart from the service's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.coordinates import wrap_rad
from companion.guidance.dialect import Autopilot, Reading, understand
from companion.guidance.geodesy import Anchor
from companion.guidance.setpoint import (
    Drop,
    Forward,
    GlobalSetpoint,
    LocalSetpoint,
    Rewrite,
    RewriteGlobal,
    RewriteOffset,
    RewriteVelocity,
    Setpoint,
    Verdict,
)
from companion.guidance.wish import express, wish_of
from companion.mavlink import codec
from companion.mavlink.framing import Framer
from companion.sim import ardupilot_input, offboard_input
from companion.sim.offboard_input import Refusal
from companion.sim.vehicle import Target
from tests.fakes.flat_world import SEC, Flight

ORIGIN = Anchor(473977420, 85455940, 0.0, 0.0)
"""The simulated autopilots' origin."""
STOPS_AFTER_NS = {Autopilot.PX4: SEC, Autopilot.ARDUPILOT: 3 * SEC}


def frame_of(setpoint: Setpoint):
    """The MAVLink frame of a setpoint, as a planner sends it."""
    if isinstance(setpoint, LocalSetpoint):
        kind = mavlink.MAVLink_set_position_target_local_ned_message
    else:
        kind = mavlink.MAVLink_set_position_target_global_int_message
    message = kind(**{name: getattr(setpoint, name) for name in type(setpoint).__slots__})
    (frame,) = Framer().feed(bytes(message.pack(mavlink.MAVLink(None, 255, 190))))
    return frame


@dataclass
class WireFlight(Flight):
    """`Flight`, on the wire, with PX4 or ArduPilot."""

    autopilot: Autopilot = Autopilot.PX4
    anchor: Anchor | None = ORIGIN

    def __post_init__(self) -> None:
        super().__post_init__()
        self.target: Target | None = None
        self.target_ns = 0
        self.times_out = True
        self.wire: list[tuple[Setpoint, Verdict, Setpoint | None]] = []

    def decide(self, setpoint: Setpoint) -> tuple[Verdict, Reading]:
        reading = understand(setpoint, self.autopilot)
        assert isinstance(reading, Reading), reading
        common = {"anchor": self.anchor, "autopilot": self.autopilot, "config": self.config}
        wish = wish_of(setpoint, reading, pose=self.switch.pose, **common)
        decision = self.switch.on_setpoint(wish, self.now)
        fresh = self.switch.pose if self.switch.pose_is_fresh(self.now) else None
        return express(decision, setpoint, reading, pose=fresh, **common), reading

    def send(self, setpoint: Setpoint | None, dt: float = 0.05) -> Verdict | None:
        """One planner period with a setpoint of any kind (None: silence)."""
        self.sense(dt)
        verdict = None
        if setpoint is not None:
            verdict, _ = self.decide(setpoint)
            self.verdicts.append((self.now, verdict))
            sent = self.leaves(setpoint, verdict)
            self.wire.append((setpoint, verdict, sent))
            if sent is not None:
                self.take(sent)
        self.move(dt)
        self.note()
        return verdict

    def leaves(self, setpoint: Setpoint, verdict: Verdict) -> Setpoint | None:
        """What is on the wire in the end."""
        frame = frame_of(setpoint)
        match verdict:
            case Forward():
                data = codec.sanitise(frame)
            case Drop():
                return None
            case Rewrite() | RewriteOffset() | RewriteVelocity() | RewriteGlobal():
                data = codec.rewrite(frame, verdict)
            case _:
                raise AssertionError(verdict)
        (out,) = Framer().feed(data)
        return codec.unpack(out)

    def take(self, sent: Setpoint) -> None:
        """The autopilot's side."""
        if not (self.armed and self.offboard):
            return
        here = (self.n + self.offset[0], self.e + self.offset[1], self.d)
        if self.autopilot is Autopilot.PX4:
            found = offboard_input.interpret(sent, self.yaw, system_id=1, component_id=1)
            target, self.times_out = found, True
        else:
            found = ardupilot_input.interpret(
                sent,
                position_ned_m=here,
                heading_rad=self.yaw,
                home_down_m=0.0,
                system_id=1,
                component_id=1,
            )
            target = found if isinstance(found, Refusal) else found.target
            self.times_out = not isinstance(found, Refusal) and found.times_out
        assert not isinstance(target, Refusal), (target, sent)
        self.target, self.target_ns = target, self.now

    def move(self, dt: float) -> None:
        target = self.target
        silent = self.now - self.target_ns > STOPS_AFTER_NS[self.autopilot]
        if target is None or (silent and self.times_out):
            target = Target((None, None, None))
        wanted = []
        for axis, here in enumerate((self.n + self.offset[0], self.e + self.offset[1], self.d)):
            place, speed = target.position_ned_m[axis], target.velocity_ned_m_s[axis]
            wanted.append(speed if place is None else speed + (place - here))
        speed = math.hypot(wanted[0], wanted[1])
        limit = 1.0 if target.position_ned_m[0] is not None else 10.0
        if speed > limit:
            wanted[0], wanted[1] = limit * wanted[0] / speed, limit * wanted[1] / speed
        blend = min(1.0, dt / 0.3)
        self.vn += blend * (wanted[0] - self.vn)
        self.ve += blend * (wanted[1] - self.ve)
        self.n += self.vn * dt
        self.e += self.ve * dt
        self.d += max(-0.5, min(0.5, wanted[2])) * dt
        rate = target.yaw_rate_rad_s or 0.0
        if target.yaw_rad is not None:
            rate = max(-2.3, min(2.3, wrap_rad(target.yaw_rad - self.yaw) / dt))
        self.yaw = wrap_rad(self.yaw + rate * dt)

    def stream(self, setpoint: Setpoint, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            self.send(setpoint)


def local(
    mask: int, frame: int = 1, p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0), yaw=0.0, rate=0.0
) -> LocalSetpoint:
    return LocalSetpoint(0, *p, *v, *a, yaw, rate, mask, 1, 1, frame)


def glob(
    mask: int, frame: int = 6, at=(0, 0), alt=1.2, v=(0.0, 0.0, 0.0), yaw=0.0, rate=0.0
) -> GlobalSetpoint:
    return GlobalSetpoint(0, *at, alt, *v, 0.0, 0.0, 0.0, yaw, rate, mask, 1, 1, frame)
