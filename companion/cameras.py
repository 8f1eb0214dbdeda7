"""``companion cameras``: what is there, one picture of it, and whether it keeps its time."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Awaitable, Callable
from contextlib import aclosing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from companion.clock import Clock, RealClock
from companion.config import LogConfig, SourceConfig
from companion.errors import CompanionError, ConfigError, SourceError
from companion.frames.capture import Capture, CaptureError
from companion.frames.open import OpenedSource, capture_opener, open_source
from companion.frames.source import Frame
from companion.frames.v4l2.device import ControlInfo, FrameSize, allowed_values
from companion.frames.v4l2.kernel import Kernel, LinuxKernel
from companion.frames.v4l2.listing import CameraListing, list_cameras
from companion.log import open_log

T = TypeVar("T")

_PATIENCE_S = 8.0
"""A camera that has not delivered by then does not work."""
_SETTLED_FRAMES = 8
_SETTLED_S = 1.0
"""Automatic exposure needs some frames; a camera of few frames a second is not waited for longer."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """How a camera kept its time.

    Attributes
    ----------
    width_px, height_px
        Size of the frames.
    frames, seconds, rate_hz
        How many came within which time.
    lost, repeated, damaged
        Frames that the driver dropped, that were the one before again, that came damaged.
    time_of
        What time stamps are the time of.
    interval_ms_median, interval_ms_longest
        Between two time stamps.
    age_ms_median, age_ms_longest
        From the time stamp to when the program has the frame.
    """

    width_px: int
    height_px: int
    frames: int
    seconds: float
    rate_hz: float
    lost: int
    repeated: int
    damaged: int
    time_of: str
    interval_ms_median: float
    interval_ms_longest: float
    age_ms_median: float
    age_ms_longest: float


def cameras_parser() -> argparse.ArgumentParser:
    """Return the command line of ``companion cameras``."""
    parser = argparse.ArgumentParser(
        prog="companion cameras",
        description="Without options: the cameras that the kernel knows, with their formats, sizes, rates and controls.",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--grab", metavar="DEVICE", help="take one picture; a device or any source.url")
    what.add_argument("--measure", metavar="DEVICE", help="measure frame rate, losses and time stamps")
    parser.add_argument(
        "-o", "--output", metavar="OUT.png", default="grab.png", help="--grab: where to (default: grab.png)"
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="--measure: for how long (default: 10)")
    parser.add_argument("--format", default="auto", help="as source.pixel_format (default: auto)")
    parser.add_argument("--size", metavar="WxH", default="", help="such as 640x480 (default: as it is set)")
    parser.add_argument(
        "--rate", type=float, default=0.0, metavar="HZ", help="frame rate (default: as it is set)"
    )
    parser.add_argument("--controls", default="", metavar="NAME=VALUE,...", help="as source.controls")
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    sys.stdout.write(answer(arguments) + "\n")
    return 0


def answer(arguments: argparse.Namespace, kernel: Kernel | None = None) -> str:
    """Do what the command line asks for and return what there is to say.

    Raises
    ------
    companion.errors.CompanionError
        When a camera cannot be used; says why.
    """
    if arguments.grab is not None:
        frame = asyncio.run(_with_source(source_config(arguments), grabbed))
        path = Path(arguments.output)
        write_image(path, frame.image)
        height_px, width_px = frame.image.shape
        return f"{path}: {width_px} x {height_px} px, mean grey {frame.image.mean():.0f}"
    if arguments.measure is not None:
        measuring = partial(measure, seconds=arguments.seconds)
        measured = asyncio.run(_with_source(source_config(arguments), measuring))
        return json.dumps(asdict(measured)) if arguments.json else measurement_text(measured)
    listings = list_cameras(kernel if kernel is not None else LinuxKernel())
    return json.dumps([asdict(found) for found in listings]) if arguments.json else listing_text(listings)


def source_config(arguments: argparse.Namespace) -> SourceConfig:
    """Return the configuration that the command's options ask for.

    Raises
    ------
    companion.errors.ConfigError
        When they are not right.
    """
    device: str = arguments.grab or arguments.measure
    width, _, height = arguments.size.lower().partition("x")
    if arguments.size and not (width.isdecimal() and height.isdecimal()):
        raise ConfigError(f"--size: found {arguments.size!r}; allowed: WIDTHxHEIGHT, such as 640x480")
    if not 0.1 <= arguments.seconds <= 86_400:
        raise ConfigError(f"--seconds: found {arguments.seconds}; allowed: 0.1 to 86400")
    try:
        return SourceConfig(
            url=f"v4l2:{device}" if device.startswith("/dev/") else device,
            pixel_format=arguments.format,
            width_px=int(width or 0),
            height_px=int(height or 0),
            rate_hz=arguments.rate,
            controls=arguments.controls,
        )
    except ValidationError as error:
        fault = error.errors()[0]
        allowed = fault.get("ctx", {}).get("error") or fault["msg"]
        raise ConfigError(
            f"{'.'.join(map(str, fault['loc']))}: found {fault['input']!r}; allowed: {allowed}"
        ) from error


async def _with_source(config: SourceConfig, use: Callable[[OpenedSource, Clock], Awaitable[T]]) -> T:
    clock = RealClock()
    if config.scheme not in ("file", "tcp"):
        _try(capture_opener(config))
    with open_log(LogConfig(level="warning")) as log:
        async with open_source(config, clock=clock, log=log) as source:
            try:
                return await use(source, clock)
            except TimeoutError as error:
                raise SourceError(f"{config.shown_url}: no frame within {_PATIENCE_S:g} s") from error


def _try(opener: Callable[[], Capture]) -> None:
    """Open and close a camera: what the service would wait for ends this command with its reason."""
    try:
        opener().close()
    except (CaptureError, OSError) as error:
        raise SourceError(str(error)) from error


async def grabbed(source: OpenedSource, clock: Clock) -> Frame:
    """Return a frame once exposure has settled; its image is a copy.

    Raises
    ------
    TimeoutError
        When none comes.
    companion.errors.SourceError
        When the source ends before.
    """
    newest: Frame | None = None
    started_ns: int | None = None
    async with aclosing(source.frames()) as frames:
        for number in range(1, _SETTLED_FRAMES + 1):
            async with asyncio.timeout(_PATIENCE_S):
                frame = await anext(frames, None)
            if frame is None:
                break
            now_ns = clock.now_ns()
            started_ns = now_ns if started_ns is None else started_ns
            newest = Frame(frame.image.copy(), frame.time_ns, frame.seq, frame.time_of)
            if number >= _SETTLED_FRAMES or now_ns - started_ns > _SETTLED_S * 1e9:
                break
    if newest is None:
        raise SourceError("the source ended without a frame")
    return newest


async def measure(source: OpenedSource, clock: Clock, seconds: float) -> Measurement:
    """Take frames for some time and return how they came.

    Raises
    ------
    TimeoutError
        When none comes.
    companion.errors.SourceError
        When the source ends before there are two.
    """
    stamps_ns: list[int] = []
    ages_ns: list[int] = []
    until_ns: int | None = None
    shape: tuple[int, ...] = (0, 0)
    time_of: set[str] = set()
    async with aclosing(source.frames()) as frames:
        while until_ns is None or clock.now_ns() < until_ns:
            async with asyncio.timeout(_PATIENCE_S):
                frame = await anext(frames, None)
            if frame is None:
                break
            now_ns = clock.now_ns()
            until_ns = now_ns + round(seconds * 1e9) if until_ns is None else until_ns
            stamps_ns.append(frame.time_ns)
            ages_ns.append(now_ns - frame.time_ns)
            shape = frame.image.shape
            time_of.add(frame.time_of)
    if len(stamps_ns) < 2:
        raise SourceError("fewer than two frames came: nothing can be said of their times")
    intervals_ms = np.diff(stamps_ns) / 1e6
    elapsed_s = (stamps_ns[-1] - stamps_ns[0]) / 1e9
    counts = source.counts
    return Measurement(
        width_px=shape[1],
        height_px=shape[0],
        frames=len(stamps_ns),
        seconds=round(elapsed_s, 3),
        rate_hz=round((len(stamps_ns) - 1) / max(elapsed_s, 1e-9), 3),
        lost=counts.lost_by_driver,
        repeated=counts.repeated,
        damaged=counts.undecodable,
        time_of=" and ".join(sorted(time_of)),
        interval_ms_median=round(float(np.median(intervals_ms)), 3),
        interval_ms_longest=round(float(intervals_ms.max()), 3),
        age_ms_median=round(float(np.median(ages_ns)) / 1e6, 3),
        age_ms_longest=round(max(ages_ns) / 1e6, 3),
    )


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture in the format that the name's ending says.

    Raises
    ------
    companion.errors.CompanionError
        When it cannot be written.
    """
    try:
        encoded, data = cv2.imencode(path.suffix or ".png", image)
    except cv2.error as error:
        raise CompanionError(f"{path}: no picture format ends in {path.suffix!r}; use .png") from error
    if not encoded:
        raise CompanionError(f"{path}: cannot be encoded")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise CompanionError(f"{path}: cannot be written: {error.strerror}") from error


def measurement_text(found: Measurement) -> str:
    """Return a measurement for people."""
    return (
        f"{found.width_px} x {found.height_px} px, {found.frames} frames in {found.seconds:.1f} s: {found.rate_hz:.2f} Hz\n"
        f"lost by the driver {found.lost}, repeated {found.repeated}, damaged {found.damaged}\n"
        f"time stamps are of the {found.time_of}; {found.interval_ms_median:.2f} ms apart, longest {found.interval_ms_longest:.2f} ms\n"
        f"age when the program has it {found.age_ms_median:.2f} ms, longest {found.age_ms_longest:.2f} ms"
    )


def listing_text(listings: tuple[CameraListing, ...]) -> str:
    """Return the cameras for people."""
    if not listings:
        return "no camera found: there is no /dev/video* that captures. A Raspberry Pi camera is used through picamera2:0."
    return "\n\n".join("\n".join(_listing_lines(listing)) for listing in listings)


def _listing_lines(listing: CameraListing) -> list[str]:
    if listing.fault:
        return [f"{listing.path}: cannot be asked: {listing.fault}"]
    who = listing.identity
    lines = [f"{who.card} ({who.driver}, {who.bus_info})"]
    lines += [f'  url = "v4l2:{name}"' for name in (*listing.links, listing.path)]
    for pixel_format in listing.formats:
        lines.append(f"  {pixel_format.name} ({pixel_format.description})")
        lines += [f"    {_size_text(size)}" for size in pixel_format.sizes]
    if listing.controls:
        lines.append("  controls")
        lines += [f"    {_control_text(control)}" for control in listing.controls]
    return lines


def _size_text(size: FrameSize) -> str:
    least = "{} x {} to ".format(*size.least_px) if size.least_px else ""
    rates = ", ".join(f"{rate_hz:g}" for rate_hz in size.rates_hz)
    return f"{least}{size.width_px} x {size.height_px} px" + (f" at {rates} Hz" if rates else "")


def _control_text(control: ControlInfo) -> str:
    state = "" if control.active else ", without effect now"
    if not control.writable:
        state += ", read only"
    return f"{control.name} = {control.value}   # {allowed_values(control)}; default {control.default}{state}"
