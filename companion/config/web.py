"""``[web]``: the live page."""

from __future__ import annotations

import ipaddress
from typing import Annotated

from pydantic import Field

from companion.config.section import Disagreement, Section


class WebConfig(Section):
    """The live page: what the camera sees and the service does, settings, recordings."""

    enabled: Annotated[
        bool,
        Field(
            description="Serve the live page. It runs in a process of its own, and needs the extra `web` (pip install 'void-companion[web]')."
        ),
    ] = False
    host: Annotated[
        str,
        Field(
            min_length=1,
            description="Address that the page is served at. 127.0.0.1: this computer alone. 0.0.0.0: every network that it is in. Any but this computer's own needs token_file.",
        ),
    ] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535, description="TCP port of the page.")] = 8080
    token_file: Annotated[
        str,
        Field(
            description="File whose first line is the token that the page asks for, 16 characters or more, readable for the service's user alone; empty: none. The connection is not encrypted: use it in networks that you trust, or through SSH."
        ),
    ] = ""
    pictures_hz: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="Pictures a second at the most. Larger: smoother, and more of a processor and of the network (Hz).",
        ),
    ] = 15.0
    picture_width_px: Annotated[
        int,
        Field(
            ge=160,
            le=1920,
            description="Pictures that are wider are made smaller for the page. Larger: sharper, and more of a processor and of the network (px).",
        ),
    ] = 640
    picture_quality: Annotated[
        int,
        Field(ge=20, le=95, description="Quality of the pictures. Larger: sharper, and more of the network."),
    ] = 70
    max_clients: Annotated[
        int,
        Field(ge=1, le=32, description="Viewers at one time; a further one is told that there is no place."),
    ] = 8
    recordings: Annotated[
        str,
        Field(
            description="Folder whose recordings (MCAP, video, folders of images) the page opens; empty: the recorder's folder where there is one, else none."
        ),
    ] = ""
    settings_file: Annotated[
        str,
        Field(
            description="Configuration file that the page compares with and saves to; empty: the one that the service was started with."
        ),
    ] = ""
    saved_file: Annotated[
        str,
        Field(
            description="File that the page saves to in place of settings_file, with nothing in it but what was saved; it is read after the drop-in files and wins over them. Empty: config.page.toml for config.toml in the state directory that systemd gives the service (STATE_DIRECTORY), unless settings_file is set; without one, settings_file itself is saved to."
        ),
    ] = ""

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if is_loopback(self.host) or self.token_file:
            return ()
        return (
            Disagreement(
                "host",
                f'"{self.host}"',
                'only "127.0.0.1", "::1" or "localhost" without web.token_file: whoever reaches the page could change settings',
            ),
        )


def is_loopback(host: str) -> bool:
    """Return whether an address is reached from this computer alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
