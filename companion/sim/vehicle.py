"""A quadrotor as its position controller lets it move: second order, with limits. No I/O, no clock.

Position error asks for a speed, speed error for an acceleration, and the acceleration follows through a
first-order lag that stands for the attitude loop; the tilt is the one that this acceleration needs. With
the default limits the response is the one measured on PX4 v1.16.1 (its own quadrotor simulator): a 10 m
step peaks at 4.9 m/s and overshoots by 0.5 m, a yaw step of 90 degrees peaks at about 140 deg/s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.coordinates import Quaternion, quaternion_from_euler, wrap_rad

Vector3 = tuple[float, float, float]

_GRAVITY_M_S2 = 9.80665
_LARGEST_STEP_S = 0.02
"""Longer steps are divided: the lags below are then resolved well."""

_TOUCHDOWN_M = 1e-3


@dataclass(frozen=True, slots=True)
class VehicleLimits:
    """What the controller allows, and how stiff it is.

    Attributes
    ----------
    max_speed_m_s, max_climb_m_s, max_descent_m_s
        Horizontal, up and down. Larger is faster, with more overshoot once ``max_acceleration_m_s2`` limits.
    max_acceleration_m_s2
        Horizontal; what ``max_tilt_deg`` can give is a limit too.
    max_vertical_acceleration_m_s2
        Up and down.
    max_tilt_deg
        Angle between the thrust and the vertical.
    max_yaw_rate_deg_s
        Rate of heading change.
    horizontal_frequency_rad_s, vertical_frequency_rad_s, yaw_frequency_rad_s
        Natural frequency of the second-order response; larger is stiffer.
    damping, yaw_damping
        Damping ratio; larger overshoots less.
    attitude_lag_s
        Time constant of the acceleration behind its command.
    """

    max_speed_m_s: float = 12.0
    max_climb_m_s: float = 3.0
    max_descent_m_s: float = 1.5
    max_acceleration_m_s2: float = 10.0
    max_vertical_acceleration_m_s2: float = 4.0
    max_tilt_deg: float = 45.0
    max_yaw_rate_deg_s: float = 200.0
    horizontal_frequency_rad_s: float = 1.0
    vertical_frequency_rad_s: float = 1.2
    yaw_frequency_rad_s: float = 3.65
    damping: float = 0.7
    yaw_damping: float = 0.8
    attitude_lag_s: float = 0.08

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and above 0, got {value}")
        if self.max_tilt_deg >= 90.0:
            raise ValueError(f"max_tilt_deg must be below 90, got {self.max_tilt_deg}")

    @classmethod
    def indoor(cls) -> VehicleLimits:
        """Return a slow profile for rooms: 1 m/s, 2 m/s^2, 20 degrees of tilt, 45 deg/s of yaw."""
        return cls(
            max_speed_m_s=1.0,
            max_climb_m_s=1.0,
            max_descent_m_s=0.7,
            max_acceleration_m_s2=2.0,
            max_tilt_deg=20.0,
            max_yaw_rate_deg_s=45.0,
            damping=0.9,
        )


@dataclass(frozen=True, slots=True)
class Target:
    """What the controller is asked for.

    Attributes
    ----------
    position_ned_m
        Local NED; None on an axis whose velocity is asked for instead.
    velocity_ned_m_s
        Feed-forward on an axis with a position, the aim itself on an axis without.
    yaw_rad
        Azimuth; None holds the heading, or turns by ``yaw_rate_rad_s`` where that is given.
    yaw_rate_rad_s
        Feed-forward with a yaw, the aim itself without. PX4, given both, follows the yaw with an offset, and
        so does this.
    """

    position_ned_m: tuple[float | None, float | None, float | None] = (None, None, None)
    velocity_ned_m_s: Vector3 = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None
    yaw_rate_rad_s: float | None = None


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Where the vehicle is and how it moves: local NED (m, m/s, m/s^2), aerospace angles (rad), body rates FRD (rad/s)."""

    position_ned_m: Vector3
    velocity_ned_m_s: Vector3
    acceleration_ned_m_s2: Vector3
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    body_rates_rad_s: Vector3
    on_ground: bool

    @property
    def q_ned_from_body(self) -> Quaternion:
        """Unit quaternion (w, x, y, z), body FRD to local NED."""
        return quaternion_from_euler(self.roll_rad, self.pitch_rad, self.yaw_rad)


class Vehicle:
    """The vehicle and its controller, stepped from outside.

    Parameters
    ----------
    limits
        Stiffness and limits; by default PX4's measured response.
    position_ned_m
        Where it stands or hovers at first.
    yaw_rad
        Its first heading.
    ground_down_m
        Height of the floor in local NED: it never sinks below.
    """

    def __init__(
        self,
        limits: VehicleLimits | None = None,
        *,
        position_ned_m: Vector3 = (0.0, 0.0, 0.0),
        yaw_rad: float = 0.0,
        ground_down_m: float = 0.0,
    ) -> None:
        self.limits = limits if limits is not None else VehicleLimits()
        self.ground_down_m = ground_down_m
        north, east, down = position_ned_m
        self._position = [north, east, min(down, ground_down_m)]
        self._velocity = [0.0, 0.0, 0.0]
        self._acceleration = [0.0, 0.0, 0.0]
        self._yaw_rad = wrap_rad(yaw_rad)
        self._yaw_rate_rad_s = 0.0
        self._held_yaw_rad: float | None = None
        self._roll_rad = 0.0
        self._pitch_rad = 0.0
        self._body_rates: Vector3 = (0.0, 0.0, 0.0)

    @property
    def on_ground(self) -> bool:
        """Whether it stands on the floor."""
        return self._position[2] >= self.ground_down_m - _TOUCHDOWN_M

    @property
    def state(self) -> VehicleState:
        """The state as of the last step."""
        return VehicleState(
            position_ned_m=(self._position[0], self._position[1], self._position[2]),
            velocity_ned_m_s=(self._velocity[0], self._velocity[1], self._velocity[2]),
            acceleration_ned_m_s2=(self._acceleration[0], self._acceleration[1], self._acceleration[2]),
            roll_rad=self._roll_rad,
            pitch_rad=self._pitch_rad,
            yaw_rad=self._yaw_rad,
            body_rates_rad_s=self._body_rates,
            on_ground=self.on_ground,
        )

    def step(self, dt_s: float, target: Target | None) -> None:
        """Move on by ``dt_s`` seconds toward ``target``; None: the motors are off, and it falls.

        Raises
        ------
        ValueError
            When ``dt_s`` is negative or not finite.
        """
        if not (math.isfinite(dt_s) and dt_s >= 0.0):
            raise ValueError(f"dt_s must be finite and not negative, got {dt_s}")
        steps = math.ceil(dt_s / _LARGEST_STEP_S)
        for _ in range(steps):
            self._step(dt_s / steps, target)

    def _step(self, dt_s: float, target: Target | None) -> None:
        if target is None:
            self._acceleration = [0.0, 0.0, 0.0 if self.on_ground else _GRAVITY_M_S2]
            self._held_yaw_rad = None
            self._yaw_rate_rad_s = 0.0
        else:
            wanted = self._wanted_acceleration(target)
            if self.on_ground and wanted[2] >= 0.0:
                # Standing with the propellers at idle: it neither slides nor turns.
                self._acceleration = [0.0, 0.0, 0.0]
                self._held_yaw_rad = None
                self._yaw_rate_rad_s = 0.0
            else:
                share = 1.0 - math.exp(-dt_s / self.limits.attitude_lag_s)
                self._acceleration = [
                    have + share * (want - have)
                    for have, want in zip(self._acceleration, wanted, strict=True)
                ]
                self._step_yaw(dt_s, target)
        for axis in range(3):
            self._velocity[axis] += self._acceleration[axis] * dt_s
            self._position[axis] += self._velocity[axis] * dt_s
        self._touch_ground()
        self._tilt(dt_s, powered=target is not None)

    def _wanted_acceleration(self, target: Target) -> Vector3:
        limits = self.limits
        north, east = (self._wanted_speed(target, axis, limits.horizontal_frequency_rad_s) for axis in (0, 1))
        north, east = _shortened(north, east, limits.max_speed_m_s)
        down = self._wanted_speed(target, 2, limits.vertical_frequency_rad_s)
        down = min(max(down, -limits.max_climb_m_s), limits.max_descent_m_s)

        gain = 2.0 * limits.damping * limits.horizontal_frequency_rad_s
        largest = min(
            limits.max_acceleration_m_s2, _GRAVITY_M_S2 * math.tan(math.radians(limits.max_tilt_deg))
        )
        a_north, a_east = _shortened(
            gain * (north - self._velocity[0]), gain * (east - self._velocity[1]), largest
        )
        a_down = 2.0 * limits.damping * limits.vertical_frequency_rad_s * (down - self._velocity[2])
        vertical = limits.max_vertical_acceleration_m_s2
        return a_north, a_east, min(max(a_down, -vertical), vertical)

    def _wanted_speed(self, target: Target, axis: int, frequency_rad_s: float) -> float:
        position = target.position_ned_m[axis]
        speed = target.velocity_ned_m_s[axis]
        if position is None:
            return speed
        # With the speed loop's gain of 2 zeta omega this makes the plain second-order system
        # a = omega^2 (error) - 2 zeta omega v wherever nothing limits.
        return speed + (position - self._position[axis]) * frequency_rad_s / (2.0 * self.limits.damping)

    def _step_yaw(self, dt_s: float, target: Target) -> None:
        limits = self.limits
        stiffness = limits.yaw_frequency_rad_s / (2.0 * limits.yaw_damping)
        feed_forward = target.yaw_rate_rad_s if target.yaw_rate_rad_s is not None else 0.0
        if target.yaw_rad is not None:
            self._held_yaw_rad = None
            rate = feed_forward + stiffness * wrap_rad(target.yaw_rad - self._yaw_rad)
        elif target.yaw_rate_rad_s is not None:
            self._held_yaw_rad = None
            rate = feed_forward
        else:
            if self._held_yaw_rad is None:
                self._held_yaw_rad = self._yaw_rad
            rate = stiffness * wrap_rad(self._held_yaw_rad - self._yaw_rad)
        largest = math.radians(limits.max_yaw_rate_deg_s)
        rate = min(max(rate, -largest), largest)
        gain = 2.0 * limits.yaw_damping * limits.yaw_frequency_rad_s
        self._yaw_rate_rad_s += gain * dt_s * (rate - self._yaw_rate_rad_s)
        self._yaw_rad = wrap_rad(self._yaw_rad + self._yaw_rate_rad_s * dt_s)

    def _touch_ground(self) -> None:
        if self._position[2] < self.ground_down_m or self._velocity[2] < 0.0:
            return
        self._position[2] = self.ground_down_m
        self._velocity = [0.0, 0.0, 0.0]
        self._acceleration = [0.0, 0.0, 0.0]

    def _tilt(self, dt_s: float, *, powered: bool) -> None:
        roll, pitch = (0.0, 0.0) if not powered or self.on_ground else self._tilt_of_thrust()
        roll_rate = (roll - self._roll_rad) / dt_s
        pitch_rate = (pitch - self._pitch_rad) / dt_s
        self._roll_rad, self._pitch_rad = roll, pitch
        # Euler angle rates to body rates.
        self._body_rates = (
            roll_rate - self._yaw_rate_rad_s * math.sin(pitch),
            pitch_rate * math.cos(roll) + self._yaw_rate_rad_s * math.sin(roll) * math.cos(pitch),
            -pitch_rate * math.sin(roll) + self._yaw_rate_rad_s * math.cos(roll) * math.cos(pitch),
        )

    def _tilt_of_thrust(self) -> tuple[float, float]:
        """Return roll and pitch that point the thrust along acceleration less gravity."""
        cos_yaw, sin_yaw = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        forward = cos_yaw * self._acceleration[0] + sin_yaw * self._acceleration[1]
        right = -sin_yaw * self._acceleration[0] + cos_yaw * self._acceleration[1]
        lift = _GRAVITY_M_S2 - self._acceleration[2]
        pitch = -math.atan2(forward, lift)
        roll = math.atan2(right * math.cos(pitch), lift)
        return roll, pitch


def _shortened(north: float, east: float, longest: float) -> tuple[float, float]:
    """Return the vector, shortened to ``longest`` where it is longer."""
    length = math.hypot(north, east)
    scale = longest / length if length > longest else 1.0
    return north * scale, east * scale
