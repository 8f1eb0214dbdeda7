"""What every simulated autopilot has behind its link: a vehicle or recorded poses, an estimate of it, and time.

The rules of modes, arming and setpoints are each autopilot's own (``flight_controller``, ``ardupilot_controller``).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections import deque

from companion.guidance.setpoint import Setpoint
from companion.sim.ardupilot_modes import CopterMode
from companion.sim.commander import Result
from companion.sim.estimate_errors import ErringEstimate
from companion.sim.mission import Mission
from companion.sim.offboard_input import Refusal
from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode
from companion.sim.recorded_poses import RecordedPoses
from companion.sim.telemetry import LandedState, Snapshot
from companion.sim.vehicle import Target, Vector3, Vehicle, VehicleState

_STEP_S = 0.005
_REPLAY_STEP_S = 0.02  # nothing is integrated then; modes still change on time
BOOT_DATE_US = 1_767_225_600_000_000
"""2026-01-01 00:00 UTC: the date at each start, so that runs repeat."""


class Controller(ABC):
    """An autopilot without its link. No I/O; time is passed in.

    Parameters
    ----------
    now_ns
        Monotonic time of the start.
    parameters
        Its parameter table.
    vehicle
        What it flies; a vehicle at PX4's response on the ground by default.
    replay
        Report these poses instead of flying.
    system_id, component_id
        Whom setpoints must be for.
    erring
        Errors of the estimate; without it the estimate is the truth, but for its jumps.
    """

    default_streams: frozenset[int] | None = None
    """Ids of the messages that it sends by itself; None: all, at their usual rates."""

    def __init__(
        self,
        now_ns: int,
        *,
        parameters: ParameterTable,
        vehicle: Vehicle | None,
        replay: RecordedPoses | None,
        system_id: int,
        component_id: int,
        erring: ErringEstimate | None,
    ) -> None:
        self.mission = Mission()
        self.parameters = parameters
        self.pilot_present = False
        self.crashed = ""
        self.texts: deque[str] = deque(maxlen=32)
        self._vehicle = vehicle if vehicle is not None else Vehicle()
        self._replay = replay
        self._replay_start_ns: int | None = None
        self._replayed: tuple[float, VehicleState] | None = None
        self._erring = erring
        self._jump: Vector3 = (0.0, 0.0, 0.0)
        self._reset_counter = 0
        self._system_id = system_id
        self._component_id = component_id
        self._boot_ns = now_ns
        self._now_ns = now_ns

    # ---- what it is doing ----

    @property
    def now_ns(self) -> int:
        """Monotonic time up to which it has been advanced."""
        return self._now_ns

    @property
    @abstractmethod
    def mode(self) -> FlightMode | CopterMode:
        """The mode it flies in."""

    @property
    @abstractmethod
    def armed(self) -> bool:
        """Whether the motors may turn."""

    @property
    @abstractmethod
    def landed(self) -> LandedState:
        """MAV_LANDED_STATE."""

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
        return dataclasses.replace(state, position_ned_m=sum_of(state.position_ned_m, self._jump))

    @abstractmethod
    def snapshot(self) -> Snapshot:
        """Return what telemetry tells, as of the last ``advance``."""

    # ---- what can be asked of it ----

    @abstractmethod
    def take_setpoint(self, setpoint: Setpoint, now_ns: int) -> Refusal | None:
        """Take a setpoint as this autopilot would; return why not, where it is refused."""

    @abstractmethod
    def request_mode_by_command(self, param2: int, param3: int, now_ns: int) -> Result:
        """Change the mode as DO_SET_MODE names it."""

    @abstractmethod
    def request_custom_mode(self, custom_mode: int, now_ns: int) -> Result:
        """Change the mode as SET_MODE names it."""

    @abstractmethod
    def request_takeoff(self, height_m: float, now_ns: int) -> Result:
        """Take off, as NAV_TAKEOFF asks for it."""

    @abstractmethod
    def request_land(self, now_ns: int) -> Result:
        """Land here."""

    @abstractmethod
    def request_return(self, now_ns: int) -> Result:
        """Return and land."""

    @abstractmethod
    def request_arm(self, now_ns: int) -> Result:
        """Arm; home is where this happens."""

    @abstractmethod
    def request_disarm(self, *, force: bool) -> Result:
        """Disarm on the ground, or anywhere by force."""

    @abstractmethod
    def reboot(self, now_ns: int) -> None:
        """Start anew: clock at zero, disarmed. The vehicle stays where it is, and falls if it flew."""

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
            if self._erring is not None:
                self._erring.step(dt_s)
            self._step(dt_s)

    def jump_estimate(self, jump_ned_m: Vector3) -> None:
        """Move the estimate at once, as an estimator reset does; the vehicle itself stays."""
        self._jump = sum_of(self._jump, jump_ned_m)
        self._reset_counter = (self._reset_counter + 1) % 256

    @abstractmethod
    def _step(self, dt_s: float) -> None:
        """Let a short time pass; ``now_ns`` is its end."""

    def _true_target(self, target: Target | None) -> Target | None:
        """Return a target given in the estimate where the vehicle's own model finds it."""
        if target is None:
            return None
        north, east, down = (
            None if p is None else p - j for p, j in zip(target.position_ned_m, self._jump, strict=True)
        )
        target = dataclasses.replace(target, position_ned_m=(north, east, down))
        return target if self._erring is None else self._erring.truth_of(target)

    def _restart(self, now_ns: int) -> None:
        """Begin anew with clock and estimate."""
        self._jump = (0.0, 0.0, 0.0)
        self._reset_counter = 0
        self._boot_ns = now_ns
        self._now_ns = now_ns
        self.texts.clear()


def sum_of(a: Vector3, b: Vector3) -> Vector3:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
