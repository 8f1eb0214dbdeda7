"""``[status]``: what other programs on this computer may ask the service."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.section import Section


class StatusConfig(Section):
    """Status for `companion status`, and metrics."""

    socket: Annotated[
        str,
        Field(
            description="Unix socket that `companion status` reads, for the service's user and group. Empty: status.sock in the runtime directory that systemd gives the service (RUNTIME_DIRECTORY), none where there is no such directory."
        ),
    ] = ""
    metrics_port: Annotated[
        int,
        Field(
            ge=0,
            le=65535,
            description="TCP port for Prometheus (http://HOST:PORT/metrics); 0: none. Larger numbers are merely other ports.",
        ),
    ] = 0
    metrics_host: Annotated[
        str,
        Field(
            description="Address that the metrics are served at. 127.0.0.1: this computer alone. Anybody who reaches another address can read them."
        ),
    ] = "127.0.0.1"
