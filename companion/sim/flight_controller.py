"""A PX4 without its link: vehicle, estimate, modes and setpoints. No I/O; time is passed in."""

from __future__ import annotations

from companion.guidance.setpoint import Setpoint
from companion.sim.commander import Answer, Commander, Result
from companion.sim.controller import BOOT_DATE_US, Controller
from companion.sim.estimate_errors import ErringEstimate
from companion.sim.navigator import Navigator, Situation
from companion.sim.offboard_input import Refusal, interpret
from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode, mode_from_custom, mode_from_numbers
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.telemetry import LandedState, Snapshot
from companion.sim.vehicle import Target, Vector3, Vehicle


class FlightController(Controller):
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
        super().__init__(
            now_ns,
            parameters=parameters if parameters is not None else ParameterTable(),
            vehicle=vehicle,
            replay=replay,
            system_id=system_id,
            component_id=component_id,
            erring=erring,
        )
        self._commander = Commander(self.parameters, mode=mode, armed=armed)
        self._navigator = Navigator(self.parameters)
        self._offboard: Target | None = None
        self._target: Target | None = None
        self._home = self.estimate.position_ned_m

    @property
    def mode(self) -> FlightMode:
        """The mode it flies in."""
        return self._commander.mode

    @property
    def armed(self) -> bool:
        """Whether the motors may turn."""
        return self._commander.armed

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
            time_unix_us=BOOT_DATE_US + boot_us,
            vehicle=self.estimate,
            mode=self.mode,
            armed=self.armed,
            landed=self.landed,
            target=self._target,
            home_ned_m=self._home,
            reset_counter=self._reset_counter,
            mission_seq=self.mission.current,
            waypoint_ned_m=None if self.mode is FlightMode.OFFBOARD else self.mission.goal(),
        )

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
        if mode is FlightMode.MISSION and self.mission.is_complete:
            return self._told(Answer(Result.TEMPORARILY_REJECTED, "No valid mission available"))
        return self._told(self._commander.request_mode(mode, now_ns))

    def request_mode_by_command(self, param2: int, param3: int, now_ns: int) -> Result:
        """Change the mode as DO_SET_MODE names it: main mode and sub-mode."""
        mode = mode_from_numbers(param2, param3)
        return Result.TEMPORARILY_REJECTED if mode is None else self.request_mode(mode, now_ns)

    def request_custom_mode(self, custom_mode: int, now_ns: int) -> Result:
        """Change the mode as SET_MODE and HEARTBEAT name it."""
        mode = mode_from_custom(custom_mode)
        return Result.TEMPORARILY_REJECTED if mode is None else self.request_mode(mode, now_ns)

    def request_takeoff(self, height_m: float, now_ns: int) -> Result:  # noqa: ARG002 - it climbs to its own parameter
        """Take off, to the height that MIS_TAKEOFF_ALT says."""
        return self.request_mode(FlightMode.TAKEOFF, now_ns)

    def request_land(self, now_ns: int) -> Result:
        """Land here."""
        return self.request_mode(FlightMode.LAND, now_ns)

    def request_return(self, now_ns: int) -> Result:
        """Return and land."""
        return self.request_mode(FlightMode.RTL, now_ns)

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
        super().jump_estimate(jump_ned_m)
        self._navigator.shift(jump_ned_m)

    def reboot(self, now_ns: int) -> None:
        """Start anew: clock at zero, disarmed, in Hold. The vehicle stays where it is, and falls if it flew."""
        self.advance(now_ns)
        self._commander = Commander(self.parameters)
        self._navigator = Navigator(self.parameters)
        self._offboard = self._target = None
        self._restart(now_ns)

    def _step(self, dt_s: float) -> None:
        estimate = self.estimate
        situation = Situation(
            mode=self.mode,
            armed=self.armed,
            position_ned_m=estimate.position_ned_m,
            home_ned_m=self._home,
            on_ground=estimate.on_ground,
            offboard=self._offboard,
            pilot_present=self.pilot_present,
            yaw_rad=estimate.yaw_rad,
            mission=self.mission,
        )
        if self.armed and self.mode is FlightMode.MISSION:
            self.mission.advance(estimate.position_ned_m)
            if self.mission.is_complete:
                self._commander.mission_complete()
                self.texts.append("Mission finished, loitering")
        self._target = self._navigator.target(situation)
        if self._replay is None:
            self._vehicle.step(dt_s, self._true_target(self._target))
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

    def _told(self, answer: Answer) -> Result:
        if answer.text:
            self.texts.append(answer.text)
        return answer.result
