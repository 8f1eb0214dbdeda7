"""Which sinks a configuration asks for."""

from __future__ import annotations

from typing import Final

from companion.config import Config

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
