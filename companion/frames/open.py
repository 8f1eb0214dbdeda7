"""The one choice of back end."""

from __future__ import annotations

from pathlib import Path

from companion.clock import Clock
from companion.config import SourceConfig
from companion.errors import SourceError
from companion.frames.file import FileSource
from companion.frames.socket import SocketSource
from companion.log import Log


def open_source(config: SourceConfig, *, clock: Clock, log: Log) -> FileSource | SocketSource:
    """Return the frame source that the configuration asks for; ``async with`` opens it.

    Parameters
    ----------
    config
        The ``[source]`` table.
    clock
        Monotonic time that frames are stamped with or checked against.
    log
        Takes the source's events.

    Raises
    ------
    companion.errors.SourceError
        When the configuration does not say enough.
    """
    if config.kind == "socket":
        host, _, port = config.address.rpartition(":")
        return SocketSource(host, int(port), clock=clock, log=log, timeout_s=config.timeout_s)
    if not config.path:
        raise SourceError('source.path is empty: with source.kind = "file" it names a video or a folder')
    return FileSource(
        Path(config.path),
        clock=clock,
        log=log,
        fps_hz=config.fps,
        fastest=config.playback == "fastest",
        loop=config.loop,
    )
