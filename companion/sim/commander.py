"""Arming and modes as PX4's commander keeps them. Pure: time and ground contact are passed in.

What was measured on PX4 v1.16.1 and is imitated here:

- OFFBOARD is refused without a fresh setpoint; once in it, silence for ``COM_OF_LOSS_T`` leads to the mode
  that ``COM_OBL_RC_ACT`` names, and the first fresh setpoint leads back, with no command.
- A mode asked for by anyone (pilot, ground station, companion) ends that, and sticks.
- After landing and disarming it goes back to the mode before, OFFBOARD included, where arming is denied.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode

_REACTION_S = 0.04
"""From the timeout to the change of mode: 0.95 Hz of setpoints must fail, 1.0 Hz must do (measured)."""

_OFFBOARD_LOSS_ACTIONS = {
    0: FlightMode.POSCTL,
    1: FlightMode.POSCTL,
    2: FlightMode.POSCTL,
    3: FlightMode.RTL,
    4: FlightMode.LAND,
    5: FlightMode.HOLD,
}


class Result(IntEnum):
    """MAV_RESULT, as in COMMAND_ACK."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a request, with the text that goes to ground stations ("" for none)."""

    result: Result
    text: str = ""


class Commander:
    """Mode and arming state.

    Parameters
    ----------
    parameters
        Read at every use, so that PARAM_SET acts.
    mode, armed
        The state to begin with.
    """

    def __init__(
        self, parameters: ParameterTable, *, mode: FlightMode = FlightMode.HOLD, armed: bool = False
    ) -> None:
        self._parameters = parameters
        self.mode = mode
        self.armed = armed
        self._intended = mode
        self._before_landing: FlightMode | None = None
        self._last_setpoint_ns: int | None = None
        self._on_ground_since_ns: int | None = None
        self._has_flown = armed

    def setpoint_taken(self, now_ns: int) -> None:
        """Note that a setpoint was accepted."""
        self._last_setpoint_ns = now_ns

    def has_fresh_setpoint(self, now_ns: int) -> bool:
        """Return whether the last accepted setpoint is younger than ``COM_OF_LOSS_T``."""
        return self._setpoint_age_s(now_ns) < self._parameters["COM_OF_LOSS_T"]

    def request_mode(self, mode: FlightMode, now_ns: int) -> Answer:
        """Change the mode for a pilot, a ground station or a companion."""
        if mode is FlightMode.OFFBOARD and not self.has_fresh_setpoint(now_ns):
            return Answer(
                Result.TEMPORARILY_REJECTED, "Switching to mode 'Offboard' is currently not available"
            )
        if mode in (FlightMode.LAND, FlightMode.RTL) and self._intended is not mode:
            self._before_landing = self._intended
        self._intended = mode
        self.mode = mode
        return Answer(Result.ACCEPTED)

    def request_arm(self, now_ns: int) -> Answer:
        """Arm, unless the mode forbids it."""
        if self.armed:
            return Answer(Result.ACCEPTED)
        if self.mode in (FlightMode.LAND, FlightMode.RTL):
            return Answer(Result.TEMPORARILY_REJECTED, "Arming denied: switch to another mode first")
        if self._intended is FlightMode.OFFBOARD and not self.has_fresh_setpoint(now_ns):
            return Answer(Result.TEMPORARILY_REJECTED, "Arming denied: no offboard signal")
        self.armed = True
        self._has_flown = False
        self._on_ground_since_ns = None
        return Answer(Result.ACCEPTED, "Armed by external command")

    def request_disarm(self, *, on_ground: bool, force: bool) -> Answer:
        """Disarm: on the ground, or anywhere by force."""
        if self.armed and not on_ground and not force:
            return Answer(Result.TEMPORARILY_REJECTED, "Disarming denied: not landed")
        was_armed = self.armed
        self._disarm()
        return Answer(Result.ACCEPTED, "Disarmed by external command" if was_armed else "")

    def takeoff_complete(self) -> None:
        """Note that AUTO.TAKEOFF has reached its height: PX4 goes on in Hold."""
        self._intended = self.mode = FlightMode.HOLD

    def mission_complete(self) -> None:
        """Note that the last waypoint is reached: PX4 goes on in Hold."""
        self._intended = self.mode = FlightMode.HOLD

    def update(self, now_ns: int, *, on_ground: bool, climbing: bool) -> list[str]:
        """Let time act: lost and regained offboard signal, disarming after landing.

        Parameters
        ----------
        now_ns
            Monotonic time.
        on_ground
            Whether the vehicle touches the floor.
        climbing
            Whether it is asked to leave it.

        Returns
        -------
        list of str
            Texts for ground stations.
        """
        texts = []
        if self._intended is FlightMode.OFFBOARD:
            lost = self._setpoint_age_s(now_ns) > self._parameters["COM_OF_LOSS_T"] + _REACTION_S
            if self.mode is FlightMode.OFFBOARD and lost and self.armed:
                action = _OFFBOARD_LOSS_ACTIONS.get(
                    int(self._parameters["COM_OBL_RC_ACT"]), FlightMode.POSCTL
                )
                self.mode = action
                texts.append("No offboard signal")
            elif self.mode is not FlightMode.OFFBOARD and self.has_fresh_setpoint(now_ns):
                self.mode = FlightMode.OFFBOARD
                texts.append("Offboard signal regained")
        if self.armed:
            texts += self._disarm_when_landed(now_ns, on_ground=on_ground, climbing=climbing)
        return texts

    def _setpoint_age_s(self, now_ns: int) -> float:
        if self._last_setpoint_ns is None:
            return float("inf")
        return (now_ns - self._last_setpoint_ns) / 1e9

    def _disarm_when_landed(self, now_ns: int, *, on_ground: bool, climbing: bool) -> list[str]:
        if not on_ground:
            self._has_flown = True
        if not on_ground or climbing:
            self._on_ground_since_ns = None
            return []
        if self._on_ground_since_ns is None:
            self._on_ground_since_ns = now_ns
        name = "COM_DISARM_LAND" if self._has_flown else "COM_DISARM_PRFLT"
        limit_s = self._parameters[name]
        if limit_s <= 0 or (now_ns - self._on_ground_since_ns) / 1e9 < limit_s:
            return []
        text = "Disarmed by landing" if self._has_flown else "Disarmed by auto preflight disarming"
        self._disarm()
        return [text]

    def _disarm(self) -> None:
        self.armed = False
        self._on_ground_since_ns = None
        if self.mode in (FlightMode.LAND, FlightMode.RTL):
            if self._intended is self.mode and self._before_landing is not None:
                self._intended = self._before_landing
            self.mode = self._intended
        self._before_landing = None
