"""The autopilot without its link: vehicle, estimate, modes and setpoints. No I/O; time is passed in."""

from __future__ import annotations

import dataclasses
from collections import deque

from companion.guidance.setpoint import Setpoint
from companion.sim.commander import Answer, Commander, Result
from companion.sim.estimate_errors import ErringEstimate
from companion.sim.navigator import Navigator, Situation
from companion.sim.offboard_input import Refusal, interpret
from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.telemetry import LandedState, Snapshot
from companion.sim.vehicle import Target, Vector3, Vehicle, VehicleState

_STEP_S = 0.005
_REPLAY_STEP_S = 0.02  # nothing is integrated then; modes still change on time
_BOOT_DATE_US = 1_767_225_600_000_000
"""2026-01-01 00:00 UTC: the date at each start, so that runs repeat."""


class FlightController:
    """Flies a vehicle, or replays recorded poses, under PX4's rules for modes and setpoints.

    Parameters
    ----------
    now_ns
        Monotonic time of the start.
    vehicle
        What it flies; a vehicle at PX4's response on the ground by default.
    replay
        Report these poses instead of flying. Modes, arming and setpoints work all the same.
    parameters
        The parameter table; defaults as PX4's.
    mode, armed
        The state to begin with. Armed above the ground means flying.
    system_id, component_id
        Whom setpoints must be for.
    erring
        Errors of the estimate; without it the estimate is the truth.
    """

    def __init__(
        self,
        now_ns: int,
        *,
        vehicle: Vehicle | None = None,
        replay: RecordedPoses | None = None,
        parameters: ParameterTable | None = None,
        mode: FlightMode = FlightMode.HOLD,
        armed: bool = False,
        system_id: int = 1,
        component_id: int = 1,
        erring: ErringEstimate | None = None,
    ) -> None:
        self.parameters = parameters if parameters is not None else ParameterTable()
        self.pilot_present = False
        self.texts: deque[str] = deque(maxlen=32)
        self._vehicle = vehicle if vehicle is not None else Vehicle()
        self._replay = replay
        self._replay_start_ns: int | None = None
        self._replayed: tuple[float, VehicleState] | None = None
        self._erring = erring
        self._commander = Commander(self.parameters, mode=mode, armed=armed)
        self._navigator = Navigator(self.parameters)
        self._offboard: Target | None = None
        self._target: Target | None = None
        self._jump: Vector3 = (0.0, 0.0, 0.0)
        self._reset_counter = 0
        self._system_id = system_id
        self._component_id = component_id
        self._boot_ns = now_ns
        self._now_ns = now_ns
        self._home = self.estimate.position_ned_m

    @property
    def now_ns(self) -> int:
        """Monotonic time up to which it has been advanced."""
        return self._now_ns

    @property
    def mode(self) -> FlightMode:
        """The mode it flies in."""
        return self._commander.mode

    @property
    def armed(self) -> bool:
        """Whether the motors may turn."""
        return self._commander.armed

    @property
    def true_state(self) -> VehicleState:
        """Where the vehicle really is: what a camera on it sees from."""
        if self._replay is None:
            return self._vehicle.state
        elapsed_s = -1.0 if self._replay_start_ns is None else (self._now_ns - self._replay_start_ns) / 1e9
        if self._replayed is None or self._replayed[0] != elapsed_s:
            self._replayed = (elapsed_s, self._replay.state_at(elapsed_s))
        return dataclasses.replace(self._replayed[1], on_ground=not self.armed)

    @property
    def estimate(self) -> VehicleState:
        """Where the autopilot believes it is: the truth, moved by the errors and jumps of the estimate so far."""
        state = self.true_state
        if self._erring is not None:
            state = self._erring.estimate_of(state)
        return dataclasses.replace(state, position_ned_m=_sum(state.position_ned_m, self._jump))

    @property
    def landed(self) -> LandedState:
        """MAV_LANDED_STATE."""
        if self.true_state.on_ground:
            return LandedState.ON_GROUND
        if self.armed and self.mode is FlightMode.TAKEOFF:
            return LandedState.TAKEOFF
        if self.armed and self._navigator.landing:
            return LandedState.LANDING
        return LandedState.IN_AIR

    def snapshot(self) -> Snapshot:
        """Return what telemetry tells, as of the last ``advance``."""
        boot_us = (self._now_ns - self._boot_ns) // 1000
        return Snapshot(
            time_boot_us=boot_us,
            time_unix_us=_BOOT_DATE_US + boot_us,
            vehicle=self.estimate,
            mode=self.mode,
            armed=self.armed,
            landed=self.landed,
            target=self._target,
            home_ned_m=self._home,
            reset_counter=self._reset_counter,
        )

    def start_replay(self, start_ns: int) -> None:
        """Say when the first recorded pose is true; it is reported before, the last one after the end.

        Raises
        ------
        ValueError
            When there is nothing to replay.
        """
        if self._replay is None:
            raise ValueError("this autopilot flies: it was made without recorded poses")
        self._replay_start_ns = start_ns

    def advance(self, now_ns: int) -> None:
        """Let time pass up to ``now_ns``; an earlier time changes nothing."""
        longest_s = _STEP_S if self._replay is None else _REPLAY_STEP_S
        while self._now_ns < now_ns:
            dt_s = min(longest_s, (now_ns - self._now_ns) / 1e9)
            self._now_ns = min(now_ns, self._now_ns + max(1, round(dt_s * 1e9)))
            self._step(dt_s)

    def take_setpoint(self, setpoint: Setpoint, now_ns: int) -> Refusal | None:
        """Take a setpoint as PX4 would; return why not, where it is refused."""
        answer = interpret(
            setpoint,
            self.estimate.yaw_rad,
            system_id=self._system_id,
            component_id=self._component_id,
            home_down_m=self._home[2],
        )
        if isinstance(answer, Refusal):
            return answer
        self._offboard = answer
        self._commander.setpoint_taken(now_ns)
        return None

    def request_mode(self, mode: FlightMode, now_ns: int) -> Result:
        """Change the mode for a pilot, a ground station or a companion."""
        return self._told(self._commander.request_mode(mode, now_ns))

    def request_arm(self, now_ns: int) -> Result:
        """Arm; home is where this happens."""
        was_armed = self.armed
        result = self._told(self._commander.request_arm(now_ns))
        if self.armed and not was_armed:
            self._home = self.estimate.position_ned_m
        return result

    def request_disarm(self, *, force: bool) -> Result:
        """Disarm on the ground, or anywhere by force."""
        on_ground = self._vehicle.on_ground if self._replay is None else True
        return self._told(self._commander.request_disarm(on_ground=on_ground, force=force))

    def jump_estimate(self, jump_ned_m: Vector3) -> None:
        """Move the estimate at once, as an estimator reset does; the vehicle itself stays."""
        self._jump = _sum(self._jump, jump_ned_m)
        self._navigator.shift(jump_ned_m)
        self._reset_counter = (self._reset_counter + 1) % 256

    def reboot(self, now_ns: int) -> None:
        """Start anew: clock at zero, disarmed, in Hold. The vehicle stays where it is, and falls if it flew."""
        self.advance(now_ns)
        self._commander = Commander(self.parameters)
        self._navigator = Navigator(self.parameters)
        self._offboard = self._target = None
        self._jump = (0.0, 0.0, 0.0)
        self._reset_counter = 0
        self._boot_ns = now_ns
        self._now_ns = now_ns
        self.texts.clear()

    def _step(self, dt_s: float) -> None:
        if self._erring is not None:
            self._erring.step(dt_s)
        estimate = self.estimate
        situation = Situation(
            mode=self.mode,
            armed=self.armed,
            position_ned_m=estimate.position_ned_m,
            home_ned_m=self._home,
            on_ground=estimate.on_ground,
            offboard=self._offboard,
            pilot_present=self.pilot_present,
        )
        self._target = self._navigator.target(situation)
        if self._replay is None:
            self._vehicle.step(dt_s, self._true_target())
            if self._navigator.takeoff_reached(situation):
                self._commander.takeoff_complete()
                self.texts.append("Takeoff completed")
        self.texts.extend(
            self._commander.update(
                self._now_ns,
                on_ground=self._replay is None and self._vehicle.on_ground,
                climbing=self._asks_to_climb(estimate.position_ned_m[2]),
            )
        )

    def _asks_to_climb(self, down_m: float) -> bool:
        if self._target is None:
            return False
        wanted_m = self._target.position_ned_m[2]
        return self._target.velocity_ned_m_s[2] < 0.0 if wanted_m is None else wanted_m < down_m

    def _true_target(self) -> Target | None:
        """Return the target where the vehicle's own model finds it."""
        if self._target is None:
            return None
        north, east, down = (
            None if p is None else p - j for p, j in zip(self._target.position_ned_m, self._jump, strict=True)
        )
        target = dataclasses.replace(self._target, position_ned_m=(north, east, down))
        return target if self._erring is None else self._erring.truth_of(target)

    def _told(self, answer: Answer) -> Result:
        if answer.text:
            self.texts.append(answer.text)
        return answer.result


def _sum(a: Vector3, b: Vector3) -> Vector3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
