"""``[recorder]``: what is recorded of a flight, when, and how much disk it may take."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.section import Disagreement, Section


class RecorderConfig(Section):
    """Recording flights: MCAP for Foxglove and `companion replay`, and a tlog for ground stations."""

    start: Annotated[
        Literal["never", "command", "armed", "always"],
        Field(
            description="never: there is no recorder. command: only `companion record start` begins. armed: with arming, too, until stop_after_s past disarming. always: as long as the service runs, too."
        ),
    ] = "never"
    folder: Annotated[
        str,
        Field(
            description="Where recordings go. Empty: recordings in the logs directory that systemd gives the service (LOGS_DIRECTORY), else in the current directory."
        ),
    ] = ""
    frames: Annotated[
        Literal["none", "jpeg", "png"],
        Field(
            description="Camera frames. jpeg: small, for looking at. png: without loss, so that a replay can look at them again bit for bit; about four times as large."
        ),
    ] = "jpeg"
    frames_hz: Annotated[
        float,
        Field(
            ge=0,
            le=240,
            description="Frames a second that are recorded at the most; 0: every one, which a replay of the detector needs (Hz). Larger: more disk and more of a core.",
        ),
    ] = 10.0
    jpeg_quality: Annotated[
        int, Field(ge=10, le=100, description="Of JPEG frames. Larger: finer and larger files.")
    ] = 85
    tlog: Annotated[
        bool,
        Field(
            description="Also a .tlog of the MAVLink on the autopilot's links, which ground stations replay."
        ),
    ] = True
    file_mib: Annotated[
        float,
        Field(
            ge=1,
            le=65536,
            description="A recording goes on in a new file when one has grown to this (MiB). Larger: fewer files; a crash costs at most the last second of one.",
        ),
    ] = 512.0
    total_mib: Annotated[
        float,
        Field(
            ge=1,
            le=1048576,
            description="All recordings of the folder together; the oldest are deleted for a new one (MiB). Larger: they are kept longer.",
        ),
    ] = 8192.0
    keep_free_mib: Annotated[
        float,
        Field(
            ge=0,
            le=1048576,
            description="Free space on the disk that recordings leave to others: the oldest are deleted for it, and when that is not enough recording stops (MiB). Larger: recording stops earlier.",
        ),
    ] = 1024.0
    stop_after_s: Annotated[
        float,
        Field(
            ge=0,
            le=600,
            description="A recording begun by arming ends so long after disarming (s). Larger: more of what follows a landing.",
        ),
    ] = 10.0

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if self.file_mib <= self.total_mib:
            return ()
        return (Disagreement("file_mib", f"{self.file_mib:g}", f"at most total_mib, {self.total_mib:g}"),)
