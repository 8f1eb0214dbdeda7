"""The kernel's virtual camera, `vivid`: one that streams test pictures and lies about nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from programs import run
from report import CheckFailedError

DRIVER = Path("/sys/bus/platform/drivers/vivid")
DEVICE = "vivid.0"
# node_types: bit 0 video capture. input_types: two bits an input, 0 a webcam.
OPTIONS = ("n_devs=1", "node_types=0x1", "num_inputs=1", "input_types=0x0")
_NODES = Path("/sys/class/video4linux")


def load() -> None:
    """Load the driver with one camera: a webcam input, no tuner, no output, no radio."""
    run("modprobe", "vivid", *OPTIONS)


def unload() -> None:
    """Take the driver out of the kernel, and its cameras with it."""
    run("modprobe", "-r", "vivid")


def unbind() -> None:
    """Pull the camera out of its driver, as if it were unplugged."""
    (DRIVER / "unbind").write_text(DEVICE)


def bind() -> None:
    """Put the camera back."""
    (DRIVER / "bind").write_text(DEVICE)


def nodes() -> list[Path]:
    """Return the camera's device nodes that stream pictures."""
    cameras = [
        Path("/dev") / entry.name
        for entry in sorted(_NODES.glob("video*"))
        if (entry / "name").read_text().startswith("vivid-000-vid-cap")
    ]
    return [node for node in cameras if node.exists()]


def node() -> Path:
    """Return the one device node, waited for."""
    until(lambda: bool(nodes()), 30.0, "a device node of vivid")
    return nodes()[0]


def until(condition: Callable[[], bool], limit_s: float, what: str) -> float:
    """Wait for a condition and return how long it took.

    Raises
    ------
    CheckFailedError
        When it does not hold in time.
    """
    started_s = time.monotonic()
    while not condition():
        if time.monotonic() - started_s > limit_s:
            raise CheckFailedError(f"{what}: not within {limit_s:.0f} s")
        time.sleep(0.05)
    return time.monotonic() - started_s
