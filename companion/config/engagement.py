"""``[engagement]``: who decides that setpoints are protected."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.section import Section


class EngagementConfig(Section):
    """When setpoints are protected. Not engaged, the planner's setpoints pass untouched."""

    by: Annotated[
        Literal["always", "rc", "command"],
        Field(
            description="always: from the start, whatever is missing holds the vehicle. rc: by a switch on the remote control. command: by MAV_CMD or the parameter VOID_ENGAGE from a ground station. rc and command engage only where nothing is missing, and say what is."
        ),
    ] = "always"
    engaged_at_start: Annotated[
        bool,
        Field(
            description="rc and command: protected until the first position of the switch, or the first command, is known. false: a service that is restarted in flight lets the planner through until then."
        ),
    ] = True
    rc_channel: Annotated[int, Field(ge=1, le=18, description="rc: channel of the switch, from 1.")] = 7
    rc_threshold_us: Annotated[
        int,
        Field(
            ge=900,
            le=2100,
            description="rc: engaged above this pulse width, with 50 us of hysteresis (us). Larger: the switch must be further up.",
        ),
    ] = 1500
