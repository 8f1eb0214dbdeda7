"""`companion cameras` and capture on the kernel's test camera."""

from __future__ import annotations

import json
from pathlib import Path

import vivid
from programs import COMPANION, PYTHON, run
from report import CheckFailedError, CheckSkippedError, check, require

FORMATS = ("GREY", "YUYV", "NV12", "MJPEG")
_FOURCC = {"MJPEG": "MJPG"}
_SIZE_PX = (640, 480)
_RATE_HZ = 5  # vivid draws its pictures on the emulated processor: at 15/s it falls behind by itself
_HERE = Path(__file__).parent
_HONEST_STAMPS = "timestamp_source=1"
"""vivid hands pictures out before the time that it says they ended; with the start of exposure it keeps to the truth."""
_CONTROLS = {
    "brightness": 90,
    "contrast": 77,
    "gain_automatic": 0,
    "gain": 60,
}  # the gain only counts after its automatic


def run_all(capture_s: float) -> None:
    """Make all checks of this module; vivid is loaded."""
    check("cameras: list", _list)
    check("cameras: grab", _grab)
    for name in FORMATS:
        check(f"capture: {name}", lambda name=name: _capture_format(name))
    check("controls: set by the configuration", _controls)
    check("controls: an unknown one is refused", _unknown_control)
    check("capture: stamps ahead of the clock", _future_stamps)
    check(f"capture: {capture_s:.0f} s, time stamps", lambda: _capture_long(capture_s))


def offered() -> set[str]:
    """Return the pixel formats that the driver offers, as v4l2-ctl says: the judge is not the judged."""
    listed = run("v4l2-ctl", "-d", str(vivid.node()), "--list-formats")
    return {line.split("'")[1].strip() for line in listed.splitlines() if "'" in line}


def _list() -> str:
    listed = json.loads(run(COMPANION, "cameras", "--json", limit_s=300))
    text = json.dumps(listed)
    node = str(vivid.node())
    require(node in text, f"{node} is not in {text[:300]}")
    missing = [name for name in sorted(offered() & {"GREY", "YUYV", "NV12"}) if f'"{name}"' not in text]
    require(not missing, f"{', '.join(missing)} offered by the driver, not listed")
    require("brightness" in text, "the control brightness is not listed")
    run(COMPANION, "cameras", limit_s=300)
    return f"{node} with formats, sizes and controls"


def _grab() -> str:
    picture = Path("/tmp/grab.png")  # noqa: S108  nobody else is in this machine
    run(COMPANION, "cameras", "--grab", str(vivid.node()), "-o", str(picture), limit_s=300)
    head = picture.read_bytes()[:8]
    require(head == b"\x89PNG\r\n\x1a\n", f"no PNG: {head!r}")
    return f"PNG of {picture.stat().st_size} bytes"


def _capture_format(name: str) -> str:
    if _FOURCC.get(name, name) not in offered():
        raise CheckSkippedError(f"vivid does not offer {name}")
    found = probe(format=name, frames=20)
    require(found["size_px"] == list(_SIZE_PX), f"size {found['size_px']}")
    # vivid's upright colour bars: with a wrong plane there are none, with a wrong line length they lean.
    require(found["contrast"] > 120, f"no colour bars: grey spans {found['contrast']:.0f}")
    require(found["skew"] < 10, f"colour bars that lean: {found['skew']:.0f} of {found['contrast']:.0f}")
    return f"{found['frames']} frames, {found['rate_hz']:.1f}/s, upright bars over {found['contrast']:.0f} of grey"


def _controls() -> str:
    asked = ", ".join(f"{name}={value}" for name, value in _CONTROLS.items())
    probe(format="GREY", frames=3, controls=asked)
    node = str(vivid.node())
    said = run("v4l2-ctl", "-d", node, "--get-ctrl", ",".join(_CONTROLS))
    found = {
        line.partition(":")[0].strip(): int(line.partition(":")[2])
        for line in said.splitlines()
        if ":" in line
    }
    require(found == _CONTROLS, f"asked {_CONTROLS}, the driver has {found}")
    run("v4l2-ctl", "-d", node, "--set-ctrl", "brightness=128,contrast=128,gain_automatic=1")
    return f"{asked}; read back by v4l2-ctl"


def _future_stamps() -> str:
    found = probe(format="GREY", frames=20, controls="timestamp_source=0")
    require(found["least_age_ms"] >= 0.0, f"a frame from the future: {found['least_age_ms']:.2f} ms")
    require(found["backward"] == 0, f"{found['backward']} time stamps do not increase")
    kind = "some by their time of arrival" if not found["of_exposure"] else "all by the driver's time"
    return f"20 frames, none from the future, {kind}"


def _unknown_control() -> str:
    try:
        probe(format="GREY", frames=1, controls="no_such_control=1", limit_s=20)
    except CheckFailedError as error:
        require("no_such_control" in str(error), str(error))
        return str(error).rpartition('"reason": ')[2][:120]
    raise CheckFailedError("a control that does not exist was taken")


def _capture_long(capture_s: float) -> str:
    found = probe(format="GREY", seconds=capture_s, controls=_HONEST_STAMPS)
    require(found["of_exposure"], "frames carry the time of arrival, not the driver's")
    require(found["backward"] == 0, f"{found['backward']} time stamps do not increase")
    require(found["least_age_ms"] >= -1.0, f"a frame from the future: {found['least_age_ms']:.2f} ms")
    # What the driver made and what came: losses are said by seq, and the interval is the driver's.
    expected = found["span_s"] * found["driver_rate_hz"]
    require(
        abs(found["numbered"] - expected) <= 0.02 * expected + 2,
        f"{found['numbered']} frames numbered in {found['span_s']:.1f} s at {found['driver_rate_hz']:g}/s",
    )
    require(found["frames"] >= 0.5 * expected, f"only {found['frames']} of {expected:.0f} frames came")
    return (
        f"{found['frames']} of {found['numbered']} frames in {found['span_s']:.1f} s, interval "
        f"{found['interval_ms'][0]:.2f}/{found['interval_ms'][1]:.2f}/{found['interval_ms'][2]:.2f} ms (p5/p50/p95), "
        f"age {found['age_ms'][0]:.1f}/{found['age_ms'][1]:.1f}/{found['age_ms'][2]:.1f} ms, "
        f"all increasing, none from the future"
    )


def probe(*, limit_s: float = 60.0, **wanted: object) -> dict[str, object]:
    """Capture in the wheel's own Python through its own source; see capture_probe.py."""
    asked = {
        "node": str(vivid.node()),
        "width_px": _SIZE_PX[0],
        "height_px": _SIZE_PX[1],
        "rate_hz": _RATE_HZ,
        **wanted,
    }
    asked["limit_s"] = limit_s + float(wanted.get("seconds", 0.0))
    said = run(PYTHON, str(_HERE / "capture_probe.py"), json.dumps(asked), limit_s=asked["limit_s"] + 240)
    return json.loads(said.splitlines()[-1])
