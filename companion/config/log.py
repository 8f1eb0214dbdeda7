"""``[log]``: what is logged, and how."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.section import Section


class LogConfig(Section):
    """Logs."""

    level: Annotated[
        Literal["debug", "info", "warning", "error"], Field(description="Least severity that is logged.")
    ] = "info"
    format: Annotated[
        Literal["auto", "text", "json"],
        Field(description="auto: text on a terminal, JSON otherwise (systemd, files, pipes)."),
    ] = "auto"
    status_interval_s: Annotated[
        float,
        Field(
            ge=0,
            le=3600,
            description="A status line with all rates and ages every so often; 0: never. Larger: a smaller log, fewer looks back (s).",
        ),
    ] = 10.0
    detections: Annotated[bool, Field(description="One line for each detection report.")] = False
    setpoints: Annotated[bool, Field(description="One line for each setpoint decision.")] = False
