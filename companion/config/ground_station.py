"""``[ground_station]``: what a ground station sees of us, and what it may change."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.section import Section


class GroundStationConfig(Section):
    """Parameters, plots and status for the ground station."""

    set_parameters: Annotated[
        Literal["always", "disarmed", "never"],
        Field(
            description="When PARAM_SET may change a setting: always, only while the vehicle is disarmed, or never."
        ),
    ] = "always"
    parameters_file: Annotated[
        str,
        Field(
            description="File that keeps what a ground station has set; it is read after the configuration and wins. Empty: companion.tuned.toml for companion.toml, in the state directory that systemd gives the service (STATE_DIRECTORY), else beside the configuration."
        ),
    ] = ""
    plot_rate_hz: Annotated[
        float,
        Field(
            ge=0,
            le=20,
            description="NAMED_VALUE_FLOAT and DEBUG_VECT for plots: sets a second; 0: none. Larger: smoother, and about 250 bytes more a set on every link (Hz).",
        ),
    ] = 1.0
    computer_status_s: Annotated[
        float,
        Field(
            ge=0,
            le=60,
            description="ONBOARD_COMPUTER_STATUS (load, memory, temperature) every so often; 0: never. Larger: less on the link, older on the screen (s).",
        ),
    ] = 5.0
    timesync_rate_hz: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="How often the autopilot is asked for its clock (TIMESYNC); 0: never, poses are then late by the link's least delay. Larger: a clock that drifts is followed sooner, more on the link (Hz).",
        ),
    ] = 1.0
