"""An ArduPilot Copter without its link: GUIDED and its time-out, LOITER, LAND, RTL, BRAKE. No I/O.

What was measured on ArduCopter 4.7-dev and is imitated here:

- GUIDED needs no stream: it is accepted at any time, holds until a setpoint comes, and flies to a position for ever. A
  velocity ends ``GUID_TIMEOUT`` after the last one, and the vehicle then brakes.
- Setpoints act in GUIDED only; any mode that is asked for, by whomever, is taken, GUIDED again too.
- It takes off by NAV_TAKEOFF in GUIDED; a setpoint does not lift it from the ground. (Not measured: setpoints while it
  takes off are ignored here.)
- By itself it sends HEARTBEAT alone; every stream is asked for.
- NaN in a used field ends it (the simulated one: a floating point exception).
"""

from __future__ import annotations

import dataclasses
import math

from companion.guidance.setpoint import Setpoint
from companion.sim.ardupilot_input import Guided, interpret
from companion.sim.ardupilot_modes import CopterMode, mode_from_number
from companion.sim.commander import Result
from companion.sim.controller import BOOT_DATE_US, Controller
from companion.sim.estimate_errors import ErringEstimate
from companion.sim.offboard_input import Refusal
from companion.sim.parameters import COPTER_DEFAULTS, ParameterTable
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.telemetry import HEARTBEAT_ALONE, LandedState, Snapshot
from companion.sim.vehicle import Target, Vector3, Vehicle

_AT_HEIGHT_M = 0.15
_AT_HOME_M = 0.5
_LANDED_S = 1.0
"""On the floor for this long with nothing that lifts it: landed, and disarmed in LAND and RTL."""
_LAND_SPEED_M_S = 0.5


class ArduPilotController(Controller):
    """Flies a vehicle, or replays recorded poses, under ArduPilot Copter's rules for modes and setpoints.

    Parameters
    ----------
    now_ns
        Monotonic time of the start.
    vehicle, replay
        What it flies, or the poses that it reports instead.
    parameters
        The parameter table; by default as ArduCopter's.
    mode, armed
        The state to begin with. Armed above the ground means flying.
    system_id, component_id
        Whom setpoints must be for.
    erring
        Errors of the estimate; without it the estimate is the truth.
    """

    default_streams = HEARTBEAT_ALONE

    def __init__(
        self,
        now_ns: int,
        *,
        vehicle: Vehicle | None = None,
        replay: RecordedPoses | None = None,
        parameters: ParameterTable | None = None,
        mode: CopterMode = CopterMode.STABILIZE,
        armed: bool = False,
        system_id: int = 1,
        component_id: int = 1,
        erring: ErringEstimate | None = None,
    ) -> None:
        super().__init__(
            now_ns,
            parameters=parameters or ParameterTable(defaults=COPTER_DEFAULTS, bytewise=False),
            vehicle=vehicle,
            replay=replay,
            system_id=system_id,
            component_id=component_id,
            erring=erring,
        )
        self._mode = mode
        self._armed = armed
        self._flies = armed and not self._vehicle.on_ground
        self._guided: Guided | None = None
        self._guided_ns = now_ns
        self._takeoff_down_m: float | None = None
        self._target: Target | None = None
        self._home = self.estimate.position_ned_m
        self._anchor = self._home
        self._on_ground_since_ns: int | None = None

    @property
    def mode(self) -> CopterMode:
        """The mode it flies in."""
        return self._mode

    @property
    def armed(self) -> bool:
        """Whether the motors may turn."""
        return self._armed

    @property
    def landed(self) -> LandedState:
        """MAV_LANDED_STATE."""
        if self.true_state.on_ground:
            return LandedState.ON_GROUND
        if self._takeoff_down_m is not None:
            return LandedState.TAKEOFF
        if self._armed and self._mode is CopterMode.LAND:
            return LandedState.LANDING
        return LandedState.IN_AIR

    def snapshot(self) -> Snapshot:
        """Return what telemetry tells, as of the last ``advance``."""
        boot_us = (self._now_ns - self._boot_ns) // 1000
        return Snapshot(
            time_boot_us=boot_us,
            time_unix_us=BOOT_DATE_US + boot_us,
            vehicle=self.estimate,
            mode=self._mode,
            armed=self._armed,
            landed=self.landed,
            target=self._target,
            home_ned_m=self._home,
            reset_counter=self._reset_counter,
            is_ardupilot=True,
            mission_seq=self.mission.current,
            waypoint_ned_m=self._waypoint(),
        )

    # ---- what can be asked of it ----

    def take_setpoint(self, setpoint: Setpoint, now_ns: int) -> Refusal | None:
        """Take a setpoint as GUIDED would; where it is not valid the vehicle stops."""
        if self._mode is not CopterMode.GUIDED:
            return Refusal("not in GUIDED")
        estimate = self.estimate
        try:
            answer = interpret(
                setpoint,
                position_ned_m=estimate.position_ned_m,
                heading_rad=estimate.yaw_rad,
                home_down_m=self._home[2],
                system_id=self._system_id,
                component_id=self._component_id,
            )
        except FloatingPointError as error:
            self.crashed = str(error)
            return Refusal("floating point exception")
        if isinstance(answer, Refusal):
            if not answer.reason.startswith("target"):
                self._stop()
            return answer
        if self._takeoff_down_m is None:
            self._guided = answer
            self._guided_ns = now_ns
        return None

    def change_mode(self, mode: CopterMode) -> Result:
        """Change the mode for a pilot, a ground station or a companion: always taken."""
        if mode is not self._mode:
            self._mode = mode
            self._anchor = self.estimate.position_ned_m
            self._takeoff_down_m = None
            self._stop()
        return Result.ACCEPTED

    def request_mode_by_command(self, param2: int, param3: int, now_ns: int) -> Result:  # noqa: ARG002 - no sub-modes
        """Change the mode as DO_SET_MODE names it: param2 is its number."""
        return self.request_custom_mode(param2, now_ns)

    def request_custom_mode(self, custom_mode: int, now_ns: int) -> Result:  # noqa: ARG002 - nothing here depends on time
        """Change the mode by its number."""
        mode = mode_from_number(custom_mode)
        if mode is None or (mode is CopterMode.AUTO and not self.mission.waypoints):
            return Result.FAILED
        return self.change_mode(mode)

    def request_takeoff(self, height_m: float, now_ns: int) -> Result:  # noqa: ARG002 - nothing here depends on time
        """Take off in GUIDED, armed and on the ground; the height is above home."""
        if self._mode is not CopterMode.GUIDED or not self._armed or not self.true_state.on_ground:
            return Result.FAILED
        if not (math.isfinite(height_m) and height_m > 0.0):
            return Result.FAILED
        self._anchor = self.estimate.position_ned_m
        self._takeoff_down_m = self._home[2] - height_m
        self._guided = None
        self._flies = True
        return Result.ACCEPTED

    def request_land(self, now_ns: int) -> Result:  # noqa: ARG002 - nothing here depends on time
        """Land here."""
        return self.change_mode(CopterMode.LAND)

    def request_return(self, now_ns: int) -> Result:  # noqa: ARG002 - nothing here depends on time
        """Return and land."""
        return self.change_mode(CopterMode.RTL)

    def request_arm(self, now_ns: int) -> Result:  # noqa: ARG002 - nothing here depends on time
        """Arm; home is where this happens."""
        if self._armed:
            return Result.ACCEPTED
        if self._mode in (CopterMode.LAND, CopterMode.RTL, CopterMode.BRAKE):
            self.texts.append("Arm: Mode not armable")
            return Result.FAILED
        self._armed = True
        self._flies = not self.true_state.on_ground
        self._home = self.estimate.position_ned_m
        self.texts.append("Arming motors")
        return Result.ACCEPTED

    def request_disarm(self, *, force: bool) -> Result:
        """Disarm on the ground, or anywhere by force."""
        if self._armed and not self.true_state.on_ground and not force:
            return Result.FAILED
        self._disarm()
        return Result.ACCEPTED

    def jump_estimate(self, jump_ned_m: Vector3) -> None:
        """Move the estimate at once; what is held moves with it."""
        super().jump_estimate(jump_ned_m)
        north, east, down = (a + j for a, j in zip(self._anchor, jump_ned_m, strict=True))
        self._anchor = (north, east, down)

    def reboot(self, now_ns: int) -> None:
        """Start anew: clock at zero, disarmed, in STABILIZE. The vehicle stays where it is, and falls if it flew."""
        self.advance(now_ns)
        self._mode = CopterMode.STABILIZE
        self._armed = self._flies = False
        self.crashed = ""
        self._takeoff_down_m = self._target = self._on_ground_since_ns = None
        self._restart(now_ns)
        self._stop()

    # ---- what it flies ----

    def _step(self, dt_s: float) -> None:
        self._target = self._choose_target()
        if self._replay is None:
            self._vehicle.step(dt_s, self._true_target(self._target))
        self._end_takeoff()
        self._disarm_when_landed()

    def _choose_target(self) -> Target | None:
        if not self._armed or self.crashed:
            return None
        if self._takeoff_down_m is not None:
            return Target((self._anchor[0], self._anchor[1], self._takeoff_down_m))
        if not self._flies:
            return Target(
                (None, None, None), (0.0, 0.0, 0.1)
            )  # motors at idle: nothing but a take-off lifts it
        match self._mode:
            case CopterMode.GUIDED:
                return self._fly_guided()
            case CopterMode.AUTO:
                return self._fly_mission()
            case CopterMode.LAND:
                return Target((self._anchor[0], self._anchor[1], None), (0.0, 0.0, _LAND_SPEED_M_S))
            case CopterMode.RTL:
                return self._return()
            case _:
                return Target(self._anchor)

    def _fly_guided(self) -> Target:
        if self._guided is None:
            return Target(self._anchor)
        target = self._guided.target
        silent_s = (self._now_ns - self._guided_ns) / 1e9
        if self._guided.times_out and silent_s > self.parameters["GUID_TIMEOUT"]:
            rate = None if target.yaw_rate_rad_s is None else 0.0
            return dataclasses.replace(target, velocity_ned_m_s=(0.0, 0.0, 0.0), yaw_rate_rad_s=rate)
        return target

    def _fly_mission(self) -> Target:
        estimate = self.estimate
        self.mission.advance(estimate.position_ned_m)
        speed_m_s = float(self.parameters["WPNAV_SPEED"]) / 100.0
        target = self.mission.target(estimate.position_ned_m, estimate.yaw_rad, speed_m_s)
        return Target(self._anchor) if target is None else target

    def _waypoint(self) -> Vector3 | None:
        """Return what POSITION_TARGET_GLOBAL_INT tells: the waypoint, in GUIDED the setpoint read back."""
        if self._mode is CopterMode.AUTO:
            return self.mission.goal()
        place = None if self._guided is None else self._guided.target.position_ned_m
        if place is None or None in place:
            return None
        return place[0] or 0.0, place[1] or 0.0, place[2] or 0.0

    def _return(self) -> Target:
        north, east, down = self.estimate.position_ned_m
        return_down_m = min(self._anchor[2], self._home[2] - float(self.parameters["RTL_ALT"]) / 100.0)
        if math.hypot(north - self._home[0], east - self._home[1]) < _AT_HOME_M:
            return Target((self._home[0], self._home[1], None), (0.0, 0.0, _LAND_SPEED_M_S))
        if down - return_down_m > _AT_HOME_M:
            return Target((self._anchor[0], self._anchor[1], return_down_m))
        return Target((self._home[0], self._home[1], return_down_m))

    def _stop(self) -> None:
        """Hold here, with no setpoint."""
        self._guided = None
        self._anchor = self.estimate.position_ned_m

    def _end_takeoff(self) -> None:
        if self._takeoff_down_m is None:
            return
        if abs(self.estimate.position_ned_m[2] - self._takeoff_down_m) < _AT_HEIGHT_M:
            north, east, _ = self._anchor
            self._anchor = (north, east, self._takeoff_down_m)
            self._takeoff_down_m = None

    def _disarm_when_landed(self) -> None:
        if self._replay is not None or not self._armed or not self._vehicle.on_ground:
            self._on_ground_since_ns = None
            return
        if self._on_ground_since_ns is None:
            self._on_ground_since_ns = self._now_ns
        since_s = (self._now_ns - self._on_ground_since_ns) / 1e9
        landing = self._mode in (CopterMode.LAND, CopterMode.RTL)
        limit_s = _LANDED_S if landing else float(self.parameters["DISARM_DELAY"])
        if self._takeoff_down_m is None and since_s > limit_s > 0.0:
            self._disarm()
            self.texts.append("Disarming motors")

    def _disarm(self) -> None:
        self._armed = self._flies = False
        self._takeoff_down_m = self._on_ground_since_ns = None
        self._guided = None
