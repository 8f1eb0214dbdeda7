"""Which sinks a configuration asks for."""

from __future__ import annotations

from companion.config import Config


def sinks_of(config: Config) -> tuple[str, ...]:
    """Return the names (``package.module:factory``) of the sinks to run; where there is none, no process is started."""
    names: list[str] = []
    if config.recorder.start != "never":
        names.append("companion.recorder.sink:build")
    return tuple(names)
