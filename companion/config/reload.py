"""``[reload]``: when the configuration is read again."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.section import Section


class ReloadConfig(Section):
    """Reading the configuration again while the service runs; SIGHUP always asks for it."""

    watch_s: Annotated[
        float,
        Field(
            ge=0,
            le=60,
            description="How often the files are looked at; one that has changed and then stood still for that long is read; 0: never, only SIGHUP (s). Larger: a saved file acts later.",
        ),
    ] = 1.0
