"""Which sinks a configuration asks for."""

from __future__ import annotations

from typing import Final

from companion.config import Config
from companion.io.messages import Kind, Wants

RECORDER: Final = "companion.recorder.sink:build"
WEB: Final = "companion.web.sink:build"


def sinks_of(config: Config) -> tuple[str, ...]:
    """Return the names (``package.module:factory``) of the sinks to run; where there is none, no process is started."""
    names: list[str] = []
    if config.recorder.start != "never":
        names.append(RECORDER)
    if config.web.enabled:
        names.append(WEB)
    return tuple(names)


def wanted_from_the_start(config: Config) -> Wants:
    """Return what is published before the sinks can say what they want: a recording that is always on begins with us."""
    if config.recorder.start != "always":
        return Wants()
    return Wants(frozenset(Kind) - {Kind.DETAILS, Kind.RING, Kind.ANSWER, Kind.FRAME})
