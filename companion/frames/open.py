"""The one choice of back end, by the scheme of the source's URL."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from companion.clock import Clock
from companion.config import SourceConfig
from companion.errors import SourceError
from companion.frames.camera import CameraLimits, CameraSource
from companion.frames.capture import Capture
from companion.frames.file import FileSource
from companion.frames.quiet import quieten_decoders
from companion.frames.socket import SocketSource
from companion.log import Log

FORMAT_LETTERS = {"auto": "", "MJPEG": "MJPG"}
"""Four letters of a pixel format where the configuration calls it otherwise."""


OpenedSource = FileSource | SocketSource | CameraSource


def open_source(config: SourceConfig, *, clock: Clock, log: Log) -> OpenedSource:
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
        When the configuration does not say enough, or what the source needs is not installed.
    """
    quieten_decoders()
    match config.scheme:
        case "":
            raise SourceError('source.url is empty: it names the camera, such as "v4l2:/dev/video0"')
        case "tcp":
            host, _, port = config.where.rpartition(":")
            return SocketSource(host, int(port), clock=clock, log=log, timeout_s=config.timeout_s)
        case "file":
            return FileSource(
                Path(config.where),
                clock=clock,
                log=log,
                fps_hz=config.fps,
                fastest=config.playback == "fastest",
                loop=config.loop,
            )
        case _:
            limits = CameraLimits(config.timeout_s, config.size_px, config.latency_ms / 1e3)
            return CameraSource(
                capture_opener(config), name=config.shown_url, clock=clock, log=log, limits=limits
            )


def capture_opener(config: SourceConfig) -> Callable[[], Capture]:
    """Return what opens the camera or stream of a configuration, again and again.

    Raises
    ------
    companion.errors.SourceError
        When what it needs is not installed; says what is missing. Recordings and raw frames are no cameras.
    """
    quieten_decoders()
    match config.scheme:
        case "v4l2":
            from companion.frames.v4l2.capture import V4l2Opener, V4l2Wish
            from companion.frames.v4l2.kernel import LinuxKernel

            wish = V4l2Wish(
                path=config.where,
                format_name=FORMAT_LETTERS.get(config.pixel_format, config.pixel_format),
                width_px=config.width_px,
                height_px=config.height_px,
                rate_hz=config.rate_hz,
                controls=config.control_values,
            )
            return V4l2Opener(wish, LinuxKernel())
        case "rtsp" | "rtsps" | "udp":
            from companion.frames.stream import StreamCapture

            return partial(StreamCapture, config.url, config.timeout_s, name=config.shown_url)
        case "picamera2":
            from companion.frames.picamera import PicameraCapture, PicameraWish, picamera2_module

            return partial(
                PicameraCapture,
                picamera2_module(),
                PicameraWish(int(config.where), config.size_px, config.rate_hz, config.control_values),
            )
        case "gst":
            from companion.frames.gstreamer import GstreamerCapture, gstreamer_command

            command = gstreamer_command(config.where, config.width_px, config.height_px)
            return partial(GstreamerCapture, command, config.width_px, config.height_px)
        case _:
            raise SourceError(f"{config.shown_url}: not a camera")
