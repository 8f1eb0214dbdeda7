"""That the machine itself is what the other checks take it for: kernel, driver, Python, wheel."""

from __future__ import annotations

import platform
from pathlib import Path

import vivid
from programs import COMPANION, PYTHON, run
from report import check, require

WHEELS = Path("/mnt/wheels")


def prepare() -> bool:
    """Check the machine and install the wheel; without this the other checks cannot be made."""
    return (
        check("kernel", _kernel)
        and check("vivid loads", _load)
        and check("driver streams (v4l2-ctl)", _stream)
        and check("wheel installs", _install)
        and check("companion starts", _starts)
    )


def _kernel() -> str:
    return f"{platform.release()}, Python {platform.python_version()}, {_processor()}"


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return "unknown processor"


def _load() -> str:
    vivid.load()
    return f"{vivid.node()}"


def _stream() -> str:
    node = str(vivid.node())
    run("v4l2-ctl", "-d", node, "--set-fmt-video=width=640,height=480,pixelformat=GREY", "--set-parm=30")
    run("v4l2-ctl", "-d", node, "--list-formats-ext")
    run("v4l2-ctl", "-d", node, "--stream-mmap", "--stream-count=30", "--verbose", limit_s=60)
    return "30 frames of 640 x 480 GREY"


def _install() -> str:
    wheels = sorted(WHEELS.glob("void_companion-*.whl"))
    require(len(wheels) == 1, f"{len(wheels)} wheels of the project")
    # Its dependencies are in the disk: the emulated processor would take minutes for them.
    run(
        PYTHON,
        "-m",
        "pip",
        "install",
        "--no-index",
        f"--find-links={WHEELS}",
        "--no-compile",
        str(wheels[0]),
        limit_s=900,
    )
    return wheels[0].name


def _starts() -> str:
    run(COMPANION, "--help", limit_s=300)
    run(COMPANION, "config", "--default", limit_s=300)
    return "companion --help, companion config --default"
