"""``[source]``: where frames come from."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from companion.config.section import Section


def _checked_host_port(address: str) -> str:
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or not 1 <= int(port) <= 65535:
        raise ValueError("HOST:PORT with a port from 1 to 65535")
    return address


class SourceConfig(Section):
    """Where frames come from."""

    kind: Annotated[
        Literal["file", "socket"],
        Field(
            description="file: a video file or a folder of images. socket: raw grey frames over loopback TCP, sent by a simulator or another program."
        ),
    ] = "file"
    path: Annotated[
        str,
        Field(
            description="file: the video, or the folder of images (sorted by name; times from its timestamps.csv, else from fps)."
        ),
    ] = ""
    address: Annotated[
        str,
        AfterValidator(_checked_host_port),
        Field(description="socket: HOST:PORT that sends the frames.", examples=["127.0.0.1:5600"]),
    ] = "127.0.0.1:5600"
    playback: Annotated[
        Literal["recorded", "fastest"], Field(description="file: at recorded speed, or as fast as possible.")
    ] = "recorded"
    loop: Annotated[
        bool,
        Field(description="file: start again at the end. Otherwise the source ends and detection stops."),
    ] = False
    fps: Annotated[
        float, Field(gt=0, le=1000, description="file: frame rate where the recording does not say (Hz).")
    ] = 10.0
    min_rate_hz: Annotated[
        float,
        Field(
            ge=0,
            le=200,
            description="Below this measured frame rate there is no detection, and that is announced. Larger: stricter.",
        ),
    ] = 2.0
    timeout_s: Annotated[
        float,
        Field(gt=0, le=60, description="No frame for this long: the camera counts as dead and is reopened."),
    ] = 1.0
