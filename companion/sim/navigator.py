"""What each flight mode asks of the position controller. Pure; positions in the estimator's local NED."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.sim.mission import Mission
from companion.sim.parameters import ParameterTable
from companion.sim.px4_modes import FlightMode
from companion.sim.vehicle import Target, Vector3

_AT_HEIGHT_M = 0.15
_AT_HOME_M = 0.5
_SINK_WITHOUT_STICKS_M_S = 0.5


@dataclass(frozen=True, slots=True)
class Situation:
    """What the choice of a target depends on.

    Attributes
    ----------
    mode, armed
        From the commander.
    position_ned_m
        The estimate.
    home_ned_m
        Where it was armed.
    on_ground
        Whether it touches the floor.
    offboard
        The last setpoint taken, if any.
    pilot_present
        Sticks centred. Without a pilot POSCTL sinks, as measured (4 m in 8 s).
    yaw_rad
        The estimated heading.
    mission
        What AUTO.MISSION flies.
    """

    mode: FlightMode
    armed: bool
    position_ned_m: Vector3
    home_ned_m: Vector3
    on_ground: bool
    offboard: Target | None
    pilot_present: bool
    yaw_rad: float
    mission: Mission


class Navigator:
    """Keeps the place and height a mode began at, and turns a mode into a target.

    Parameters
    ----------
    parameters
        Heights and speeds, read at every use.
    """

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._mode: FlightMode | None = None
        self._anchor: Vector3 = (0.0, 0.0, 0.0)
        self._takeoff_down_m = 0.0
        self._landing = False

    @property
    def landing(self) -> bool:
        """Whether the last target was a descent to the floor."""
        return self._landing

    def shift(self, jump_ned_m: Vector3) -> None:
        """Move what is held with a jump of the estimate, as PX4 does on a reset."""
        north, east, down = (a + j for a, j in zip(self._anchor, jump_ned_m, strict=True))
        self._anchor = (north, east, down)
        self._takeoff_down_m += jump_ned_m[2]

    def takeoff_reached(self, situation: Situation) -> bool:
        """Return whether AUTO.TAKEOFF is done."""
        return (
            situation.mode is FlightMode.TAKEOFF
            and self._mode is FlightMode.TAKEOFF
            and situation.armed
            and abs(situation.position_ned_m[2] - self._takeoff_down_m) < _AT_HEIGHT_M
        )

    def target(self, situation: Situation) -> Target | None:
        """Return what to fly, or None when the motors are off."""
        if not situation.armed:
            self._mode = None
            self._landing = False
            return None
        if situation.mode is not self._mode:
            self._enter(situation)
        self._landing = False
        match situation.mode:
            case FlightMode.OFFBOARD:
                return situation.offboard if situation.offboard is not None else self._hold(situation)
            case FlightMode.MISSION:
                return self._fly_mission(situation)
            case FlightMode.HOLD:
                return self._hold(situation)
            case FlightMode.TAKEOFF:
                north, east, _ = self._anchor
                climb_m_s = -float(self._parameters["MPC_TKO_SPEED"])
                if situation.position_ned_m[2] - self._takeoff_down_m > 1.0:
                    return Target((north, east, None), (0.0, 0.0, climb_m_s))
                return Target((north, east, self._takeoff_down_m))
            case FlightMode.POSCTL:
                if situation.pilot_present:
                    return self._hold(situation)
                return Target((self._anchor[0], self._anchor[1], None), (0.0, 0.0, _SINK_WITHOUT_STICKS_M_S))
            case FlightMode.LAND:
                return self._land(self._anchor[0], self._anchor[1])
            case FlightMode.RTL:
                return self._return(situation)

    def _enter(self, situation: Situation) -> None:
        self._mode = situation.mode
        self._anchor = situation.position_ned_m
        if situation.mode is FlightMode.TAKEOFF:
            height_m = float(self._parameters["MIS_TAKEOFF_ALT"])
            self._takeoff_down_m = min(situation.home_ned_m[2] - height_m, situation.position_ned_m[2])
        if situation.mode is FlightMode.RTL:
            north, east, down = situation.position_ned_m
            return_m = float(self._parameters["RTL_RETURN_ALT"])
            self._anchor = (north, east, min(down, situation.home_ned_m[2] - return_m))

    def _hold(self, situation: Situation) -> Target:
        if situation.on_ground:
            # Armed on the floor: hold must not lift it, whatever the estimator's noise.
            return Target((self._anchor[0], self._anchor[1], None), (0.0, 0.0, 0.1))
        return Target(self._anchor)

    def _fly_mission(self, situation: Situation) -> Target:
        speed_m_s = float(self._parameters["MPC_XY_CRUISE"])
        target = situation.mission.target(situation.position_ned_m, situation.yaw_rad, speed_m_s)
        return self._hold(situation) if target is None else target

    def _land(self, north_m: float, east_m: float) -> Target:
        self._landing = True
        return Target((north_m, east_m, None), (0.0, 0.0, float(self._parameters["MPC_LAND_SPEED"])))

    def _return(self, situation: Situation) -> Target:
        home_north, home_east, _ = situation.home_ned_m
        north, east, down = situation.position_ned_m
        if math.hypot(north - home_north, east - home_east) < _AT_HOME_M:
            return self._land(home_north, home_east)
        if down - self._anchor[2] > _AT_HOME_M:
            return Target(self._anchor)  # climb before flying back
        return Target((home_north, home_east, self._anchor[2]))
