"""``[link]``: planner and autopilot side, our own ids, signing."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from companion.config.endpoint_url import parse_endpoint_url
from companion.config.link_filter import FilterRule, parse_filter_rule
from companion.config.section import Disagreement, Section


def _checked_endpoints(found: object) -> object:
    urls = found if isinstance(found, list) else [found]
    if not urls:
        raise ValueError("at least one endpoint")
    for url in urls:
        if not isinstance(url, str):
            raise ValueError('an endpoint such as "udpin:127.0.0.1:14540", or a list of such')  # noqa: TRY004  pydantic takes ValueError
        parse_endpoint_url(url)
    return found


def _checked_filters(found: object) -> object:
    if not isinstance(found, list) or not all(isinstance(rule, str) for rule in found):
        raise ValueError('a list of rules such as "deny out planner message=30,31"')
    for rule in found:
        parse_filter_rule(rule)
    return found


class LinkConfig(Section):
    """The two sides of the inline proxy, with one endpoint or several each."""

    planner: Annotated[
        str | list[str],
        BeforeValidator(_checked_endpoints),
        Field(
            description="Planner and ground-station side: one endpoint, or a list. udpin:HOST:PORT and tcpin:HOST:PORT listen, udpout:HOST:PORT and tcp:HOST:PORT call, serial:/dev/serial/by-id/NAME:BAUD is a line.",
            examples=["udpin:127.0.0.1:14540", "udpout:192.168.1.20:14550"],
        ),
    ] = "udpin:127.0.0.1:14540"
    autopilot: Annotated[
        str | list[str],
        BeforeValidator(_checked_endpoints),
        Field(
            description="Autopilot side, in the same forms.",
            examples=["udpin:127.0.0.1:14541", "serial:/dev/serial/by-id/usb-Auterion_PX4-if00:921600"],
        ),
    ] = "udpin:127.0.0.1:14541"
    filters: Annotated[
        list[str],
        BeforeValidator(_checked_filters),
        Field(
            description="What links let in and out: allow or deny, in or out, a link (planner, planner.2, autopilot, * for all), then system=, component= and message= with ids of the sender and message, as 1,5-7. The first rule that matches decides; a link with an allow rule denies what no rule matches.",
            examples=["deny out planner.2 message=30-32", "deny in planner system=200-254"],
        ),
    ] = []  # noqa: RUF012  pydantic copies it for each instance
    event_loop: Annotated[
        Literal["auto", "asyncio"],
        Field(
            description="auto: uvloop where it is installed (extra `fast`), which forwards at less cost. asyncio: Python's own."
        ),
    ] = "auto"
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

    @property
    def planner_urls(self) -> tuple[str, ...]:
        """The planner side's endpoints."""
        return (self.planner,) if isinstance(self.planner, str) else tuple(self.planner)

    @property
    def autopilot_urls(self) -> tuple[str, ...]:
        """The autopilot side's endpoints."""
        return (self.autopilot,) if isinstance(self.autopilot, str) else tuple(self.autopilot)

    @property
    def filter_rules(self) -> tuple[FilterRule, ...]:
        """What links let in and out."""
        return tuple(parse_filter_rule(rule) for rule in self.filters)

    def _disagreements(self) -> tuple[Disagreement, ...]:
        seen: set[str] = set()
        for key, urls in (("planner", self.planner_urls), ("autopilot", self.autopilot_urls)):
            for url in urls:
                if url in seen and not parse_endpoint_url(url).may_repeat:
                    allowed = (
                        "another endpoint than planner's" if key == "autopilot" else "each endpoint once"
                    )
                    return (Disagreement(key, f'"{url}"', allowed),)
                seen.add(url)
        return ()
