"""``[link]``: planner and autopilot side, our own ids, signing."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from companion.config.section import Disagreement, Section


def _checked_udp_endpoint(endpoint: str) -> str:
    port = int(endpoint.rpartition(":")[2])
    least = 0 if endpoint.startswith("udpin:") else 1
    if not least <= port <= 65535:
        raise ValueError(f"a port from {least} to 65535" + (" (0: any free one)" if least == 0 else ""))
    return endpoint


class LinkConfig(Section):
    """The two UDP sides of the inline proxy."""

    planner: Annotated[
        str,
        Field(
            pattern=r"^udp(in|out):[^:]+:[0-9]{1,5}$",
            description="Planner and ground-station side. udpin:HOST:PORT listens, udpout:HOST:PORT sends first.",
            examples=["udpin:127.0.0.1:14540", "udpout:192.168.1.20:14550"],
        ),
        AfterValidator(_checked_udp_endpoint),
    ] = "udpin:127.0.0.1:14540"
    autopilot: Annotated[
        str,
        Field(
            pattern=r"^udp(in|out):[^:]+:[0-9]{1,5}$",
            description="Autopilot side, in the same form.",
            examples=["udpin:127.0.0.1:14541", "udpout:127.0.0.1:14580"],
        ),
        AfterValidator(_checked_udp_endpoint),
    ] = "udpin:127.0.0.1:14541"
    component_id: Annotated[
        int, Field(ge=1, le=255, description="Our own component id (191 MAV_COMP_ID_ONBOARD_COMPUTER).")
    ] = 191
    planner_system_id: Annotated[
        int,
        Field(
            ge=0,
            le=255,
            description="System id of the planner. Setpoints of others pass untouched and unprotected, announced. 0: any.",
        ),
    ] = 0
    planner_component_id: Annotated[
        int, Field(ge=0, le=255, description="Component id of the planner, likewise. 0: any.")
    ] = 0
    signing_key_file: Annotated[
        str,
        Field(
            description="Key of MAVLink 2 signing: 32 bytes, or 64 hexadecimal digits, in a file that its owner alone may read. Signed setpoints are verified and signed again, our own messages are signed. Empty: signed setpoints pass untouched and unprotected, with an alarm."
        ),
    ] = ""
    signing_link_id: Annotated[
        int,
        Field(
            ge=0, le=255, description="Our link id in signatures. No other link of the network may use it."
        ),
    ] = 200

    def _disagreements(self) -> tuple[Disagreement, ...]:
        same = self.planner == self.autopilot and not self.planner.endswith(":0")
        if not same:
            return ()
        return (Disagreement("autopilot", f'"{self.autopilot}"', "another endpoint than planner's"),)
