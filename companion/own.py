"""Puts our own component together: parameters, commands, engagement, clock, plots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import common as mavlink

from companion.config import Config
from companion.engagement import EngagementControl
from companion.guidance.substitution import State
from companion.host_status import Host
from companion.interception import Interception
from companion.log import Log
from companion.mavlink.commands import AUTOPILOT_VERSION, CommandServer, version_message
from companion.mavlink.component import OwnComponent
from companion.mavlink.identity import Identity, MavSeverity, heartbeat_message
from companion.mavlink.parameters import ParameterServer
from companion.mavlink.plots import (
    DEBUG_VECT,
    NAMED_VALUE_FLOAT,
    ONBOARD_COMPUTER_STATUS,
    Intervals,
    computer_status,
    debug_vect,
    interval_of,
    named_values,
)
from companion.mavlink.signing import Signatures
from companion.mavlink.timesync import ClockSync
from companion.settings import ENGAGE, Settings

_PACKAGE: Final = "void-companion"
_STATES: Final = tuple(State)


class Own:
    """Our own component and what it changes; the service drives it.

    Parameters
    ----------
    config
        The configuration as it was read.
    flight
        What is engaged and tuned.
    identity
        Our voice.
    log
        Takes the events.
    now_ns
        The time at the start.
    apply
        Takes settings that act outside of the flight, such as the floor of the frame rate.
    signatures
        Where there is a key, only what is signed with it is obeyed.
    """

    def __init__(
        self,
        config: Config,
        flight: Interception,
        identity: Identity,
        *,
        log: Log,
        now_ns: int,
        apply: Callable[[Config], None],
        signatures: Signatures | None,
    ) -> None:
        self._flight = flight
        self._identity = identity
        self._apply = apply
        station = config.ground_station
        self._intervals = Intervals(
            {
                NAMED_VALUE_FLOAT: interval_of(station.plot_rate_hz),
                DEBUG_VECT: interval_of(station.plot_rate_hz),
                ONBOARD_COMPUTER_STATUS: round(1e6 * station.computer_status_s) or -1,
            }
        )
        self._host = Host(Path(station.parameters_file).parent if station.parameters_file else Path())
        self.engagement = EngagementControl(
            config.engagement, flight, speaker=identity, log=log, now_ns=now_ns
        )
        self.settings = Settings(
            config,
            apply=self._apply_settings,
            engaged=lambda: self.engagement.engaged,
            engage=self.engagement.command,
            is_armed=lambda: flight.armed,
            log=log,
        )
        rate_hz = station.timesync_rate_hz
        self.component = OwnComponent(
            identity,
            self,
            parameter_server=ParameterServer(self.settings),
            command_server=CommandServer(
                engage=self._engage_by_command,
                messages={
                    mavlink.MAVLINK_MSG_ID_HEARTBEAT: lambda at: heartbeat_message(flight.mav_state(at)),
                    AUTOPILOT_VERSION: lambda _: version_message(
                        version(_PACKAGE), identity.system_id, identity.component_id
                    ),
                    ONBOARD_COMPUTER_STATUS: lambda at: computer_status(self._host.look(), at),
                },
                streams=self._intervals,
            ),
            produce=self._produce,
            engagement=config.engagement,
            timesync_interval_ns=round(1e9 / rate_hz) if rate_hz else 0,
            signatures=signatures,
        )

    # ------------------------------------------------------------------ from the autopilot

    def on_rc_channels(self, pulses_us: tuple[int, ...], now_ns: int) -> None:
        """Take the channels of the remote control."""
        was = self.engagement.engaged
        self.engagement.on_rc_channels(pulses_us, now_ns)
        self._show_engaged(was)

    def on_estimator(self, flags: int, now_ns: int) -> None:
        """Take what the estimator says of itself."""
        self._flight.on_estimator(flags, now_ns)

    def on_clock(self, sync: ClockSync, now_ns: int) -> None:
        """Take what the autopilot's clock is against ours."""
        self._flight.on_clock(sync, now_ns)

    # ------------------------------------------------------------------ to the ground station

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return clock and engagement for the status line."""
        sync = self.component.timesync.best(now_ns)
        return {
            "engaged": self.engagement.engaged,
            "clock_round_trip_ms": None if sync is None else round(sync.round_trip_ns / 1e6, 2),
        }

    def complain(self, text: str) -> None:
        """Tell the ground station that settings are not kept."""
        self._identity.status_text(MavSeverity.WARNING, f"void: settings not kept: {text}")

    def _engage_by_command(self, on: bool, now_ns: int, sender: str) -> bool:
        was = self.engagement.engaged
        answer = self.engagement.command(on, now_ns, f"command of {sender}")
        self._show_engaged(was)
        return answer.accepted

    def _show_engaged(self, was: bool) -> None:
        if self.engagement.engaged != was:
            self.component.announce(ENGAGE)

    def _apply_settings(self, config: Config) -> None:
        self._flight.set_config(config)
        interval_us = interval_of(config.ground_station.plot_rate_hz)
        self._intervals.configure(NAMED_VALUE_FLOAT, interval_us)
        self._intervals.configure(DEBUG_VECT, interval_us)
        self._apply(config)

    def _produce(self, now_ns: int) -> list[mavlink.MAVLink_message]:
        """Return the plots and the computer's status that are due."""
        messages: list[mavlink.MAVLink_message] = []
        plots = self._intervals.is_due(NAMED_VALUE_FLOAT, now_ns)
        vector = self._intervals.is_due(DEBUG_VECT, now_ns)
        if plots or vector:
            status = {**self._flight.status(now_ns), **self.status(now_ns)}
            if plots:
                messages += named_values(plotted(status), now_ns)
            sent = status.get("setpoint", {}).get("sent")
            if vector and sent is not None:
                messages.append(
                    debug_vect("void_sent", (float(sent[0]), float(sent[1]), float(sent[2])), now_ns)
                )
        if self._intervals.is_due(ONBOARD_COMPUTER_STATUS, now_ns):
            messages.append(computer_status(self._host.look(), now_ns))
        return messages


def plotted(status: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers of a status line that are worth a plot, by names of at most 10 characters."""
    report = status.get("report", {})
    return {
        "void_state": float(_STATES.index(State(status["state"]))),
        "void_ready": float(status["not_ready"] is None),
        "void_eng": float(status["engaged"]),
        "void_fps": status["frames_hz"],
        "void_rep": status["reports_hz"],
        "void_sp": status["setpoints_hz"],
        "void_pose": status["pose_age_ms"],
        "void_age": report.get("age_ms"),
        "void_rtt": status["clock_round_trip_ms"],
    }
