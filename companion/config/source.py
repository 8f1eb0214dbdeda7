"""``[source]``: where frames come from."""

from __future__ import annotations

import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from companion.config.section import Disagreement, Section

_SCHEMES: Final = ("v4l2", "picamera2", "rtsp", "rtsps", "udp", "gst", "file", "tcp")
_CONTROL: Final = re.compile(r"\s*([A-Za-z0-9_]+)\s*=\s*([^=,]*[^=,\s])\s*")


def _checked_url(url: str) -> str:
    scheme, colon, rest = url.partition(":")
    if not url:
        return url
    if not colon or scheme not in _SCHEMES:
        raise ValueError("SCHEME:WHERE with one of the schemes " + ", ".join(_SCHEMES))
    match scheme:
        case "tcp":
            _check_host_port(rest)
        case "v4l2" if not rest.startswith("/"):
            raise ValueError("v4l2:PATH with the whole path of a device, such as v4l2:/dev/video0")
        case "picamera2" if not (rest.isascii() and rest.isdecimal()):
            raise ValueError("picamera2:NUMBER, 0 for the first camera")
        case "rtsp" | "rtsps" | "udp" if not (rest.startswith("//") and rest[2:]):
            raise ValueError(f"{scheme}://HOST:PORT and what follows")
        case "gst" | "file" if not rest:
            raise ValueError("something after " + scheme + ":")
    return url


def _check_host_port(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or not 1 <= int(port) <= 65535:
        raise ValueError("tcp:HOST:PORT with a port from 1 to 65535")


def _checked_controls(text: str) -> str:
    if not all(_CONTROL.fullmatch(part) for part in text.split(",") if text.strip()):
        raise ValueError("NAME=VALUE, NAME=VALUE with names as `companion cameras` lists them")
    return text


class SourceConfig(Section):
    """Where frames come from."""

    url: Annotated[
        str,
        AfterValidator(_checked_url),
        Field(
            description="v4l2:/dev/v4l/by-id/...: a USB or other camera of the kernel (`companion cameras` lists them). picamera2:0: a Raspberry Pi camera. rtsp://... or udp://...: a video stream. gst:PIPELINE: a GStreamer pipeline. file:PATH: a video, or a folder of images (sorted by name; times from its timestamps.csv, else from fps). tcp:HOST:PORT: raw grey frames, sent by a simulator or another program.",
            examples=["v4l2:/dev/video0", "file:walk.mp4"],
        ),
    ] = ""
    pixel_format: Annotated[
        Literal["auto", "GREY", "YUYV", "UYVY", "NV12", "MJPEG"],
        Field(
            description="v4l2: pixel format; auto is the one that costs least at the size and rate. GREY, NV12 and YUYV cost nothing; MJPEG is decoded, and is often the only fast one at large sizes."
        ),
    ] = "auto"
    width_px: Annotated[
        int,
        Field(
            ge=0,
            le=8192,
            description="Cameras: width that is asked for; 0: as the camera has it. Frames of another size are refused. 640 x 480 is enough; larger costs time and hardly helps (px).",
        ),
    ] = 0
    height_px: Annotated[
        int,
        Field(
            ge=0,
            le=8192,
            description="Cameras: height; goes with width_px. Larger: slower, and hardly better (px).",
        ),
    ] = 0
    rate_hz: Annotated[
        float,
        Field(
            ge=0,
            le=500,
            description="Cameras: frame rate that is asked for; 0: as the camera has it. Larger: newer frames, and less time to expose each (Hz).",
        ),
    ] = 0.0
    controls: Annotated[
        str,
        AfterValidator(_checked_controls),
        Field(
            description="v4l2 and picamera2: controls of the camera by name, set in this order.",
            examples=["auto_exposure=manual_mode, exposure_time_absolute=80"],
        ),
    ] = ""
    latency_ms: Annotated[
        float,
        Field(
            ge=-200,
            le=2000,
            description="Cameras and streams: how long before its time stamp a frame was exposed; subtracted. Needed where frames only have a time of arrival. Larger: frames count as older; where it is wrong, directions are while turning (ms).",
        ),
    ] = 0.0
    playback: Annotated[
        Literal["recorded", "fastest"], Field(description="file: at recorded speed, or as fast as possible.")
    ] = "recorded"
    loop: Annotated[
        bool,
        Field(description="file: start again at the end. Otherwise the source ends and detection stops."),
    ] = False
    fps: Annotated[
        float,
        Field(
            gt=0,
            le=1000,
            description="file: frame rate where the recording does not say. Larger: played faster than it was recorded (Hz).",
        ),
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
        Field(
            gt=0,
            le=60,
            description="No new picture for this long (nothing, only damaged ones, or the same one again and again): the camera counts as dead and is opened again. Larger: a dead camera is noticed later; smaller: a slow one is taken for dead (s).",
        ),
    ] = 1.0

    @property
    def scheme(self) -> str:
        """What kind of source it is; "" where none is named."""
        return self.url.partition(":")[0]

    @property
    def where(self) -> str:
        """The part of the URL after the scheme and its colon."""
        return self.url.partition(":")[2]

    @property
    def shown_url(self) -> str:
        """The URL without user and password, for logs."""
        scheme, separator, rest = self.url.partition("://")
        if not separator:
            return self.url
        host, slash, path = rest.partition("/")
        return f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"

    @property
    def size_px(self) -> tuple[int, int] | None:
        """(width, height) that is asked for, or None."""
        return (self.width_px, self.height_px) if self.width_px else None

    @property
    def control_values(self) -> tuple[tuple[str, str], ...]:
        """Names and values of the controls, in their order."""
        found = (_CONTROL.fullmatch(part) for part in self.controls.split(","))
        return tuple((match[1], match[2]) for match in found if match)

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if bool(self.width_px) == bool(self.height_px):
            return ()
        missing, given = ("height_px", "width_px") if self.width_px else ("width_px", "height_px")
        return (Disagreement(missing, "0", f"both sizes or neither: {given} is set"),)
