"""The report of the parallax method on one pair: its figures, as JSON and as Markdown."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.commands import side_by_side_table
from detector.commands.detect import as_dict, kind_of
from detector.commands.inputs import json_clean
from detector.commands.side_by_side_table import SideBySide
from detector.overlay import headline
from detector.parallax.params import ParallaxParams
from detector.parallax.pipeline import Intrinsics, ParallaxDetector, ParallaxResult
from detector.params import DetectorParams
from detector.pipeline import PairResult
from detector.results import Direction, MotionEstimate

FIGURES: Final = ("flow", "ranges", "map", "polar")

CAPTIONS: Final = {
    "flow": "The flow that the rotation leaves, with the uncertainty that the picture's texture leaves it, and where the camera is going.",
    "ranges": "What each sample says of its range. A grey dot says nothing: a plain surface shows no flow, which is not the same as far away.",
    "map": "How far the vehicle could fly level in each direction, on the horizon of the later frame.",
    "polar": "The same from above.",
}

_STEPS: Final = (
    ("frames", "frame quality"),
    ("flow", "flow both ways, refined, with its information"),
    ("motion", "rotation and direction of travel"),
    ("plane", "plane or depth"),
    ("ranges", "ranges"),
    ("map", "void map and answer"),
)


@dataclass(frozen=True, slots=True)
class ParallaxPair:
    """The input of a report.

    Attributes
    ----------
    earlier, later
        (H, W) uint8.
    camera
        None: a field of view is assumed.
    camera_source
        Where the camera came from: ``calibration`` or ``field_of_view``.
    later_from_earlier, translation_earlier_m
        As :meth:`detector.parallax.pipeline.ParallaxDetector.detect` takes them.
    """

    earlier: NDArray[np.uint8]
    later: NDArray[np.uint8]
    camera: CameraModel | None = None
    camera_source: str = "calibration"
    later_from_earlier: NDArray[np.float64] | None = None
    translation_earlier_m: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class ParallaxReport:
    """Everything that a report shows.

    Attributes
    ----------
    earlier, later
        Names of the two images.
    size_px
        Their width and height.
    result
        The answer.
    baseline_m, interval_s
        Between the two frames, where they are known.
    seconds
        Of each step, the median of ``loops``.
    loops
        How often the pair was answered for it.
    pictures
        File names of the figures, by figure.
    side_by_side
        What all methods say of the pair.
    """

    earlier: str
    later: str
    size_px: tuple[int, int]
    result: ParallaxResult
    baseline_m: float | None
    interval_s: float | None
    seconds: dict[str, float]
    loops: int
    pictures: dict[str, str]
    side_by_side: SideBySide


def examine(
    pair: ParallaxPair, params: DetectorParams, *, loops: int = 5
) -> tuple[ParallaxResult, dict[str, float]]:
    """Return the answer to a pair and the seconds of each step, medians.

    Parameters
    ----------
    pair
        Input.
    params
        What counts as a usable frame.
    loops
        Times that it is answered, after one that warms up.

    Raises
    ------
    ValueError
        As :meth:`detector.parallax.pipeline.ParallaxDetector.detect` does.
    """
    if loops < 1:
        raise ValueError(f"loops: expected 1 or more, got {loops}")
    detector = ParallaxDetector(ParallaxParams(), frame_params=params)
    intrinsics = None if pair.camera is None else Intrinsics(pair.camera, pair.camera_source)

    def once() -> ParallaxResult:
        return detector.detect(
            pair.earlier,
            pair.later,
            intrinsics=intrinsics,
            later_from_earlier=pair.later_from_earlier,
            translation_earlier_m=pair.translation_earlier_m,
        )

    result = once()
    runs = [once().detection.diagnostics.seconds for _ in range(loops)]
    return result, {name: float(np.median([run[name] for run in runs])) for name in runs[0]}


def as_json(report: ParallaxReport) -> dict[str, Any]:
    """Return the report as plain values that JSON can hold; docs/report.md says what each is."""
    result, found = report.result, report.result.detection.diagnostics
    motion = found.motion
    content = {
        "earlier": report.earlier,
        "later": report.later,
        "size_px": list(report.size_px),
        "method": "parallax",
        "answer": as_dict(
            PairResult(result.detection, result.tracks, result.focus_px), report.baseline_m, report.interval_s
        ),
        "motion": None if motion is None else dataclasses.asdict(motion),
        "samples": _samples(result),
        "map": _map(result),
        "gap": _gap(result),
        "seconds": {"loops": report.loops, "steps": report.seconds, "total": sum(report.seconds.values())},
        "side_by_side": side_by_side_table.as_json(report.side_by_side),
        "pictures": report.pictures,
    }
    cleaned: dict[str, Any] = json_clean(content)
    return cleaned


def _samples(result: ParallaxResult) -> dict[str, int]:
    field, geometry = result.field, result.geometry
    return {
        "grid": 0 if field is None else len(field),
        "textured": 0 if field is None else int(field.textured.sum()),
        "believed": 0 if field is None else int(field.believed.sum()),
        "fit_the_motion": 0 if geometry is None else len(geometry.samples),
        "tell_their_range": 0 if geometry is None else int(geometry.samples.informative.sum()),
    }


def _map(result: ParallaxResult) -> dict[str, Any] | None:
    if result.decision is None or result.geometry is None:
        return None
    found = result.decision.void_map
    known = np.flatnonzero(found.known)
    axis = result.geometry.frame_from_later[:, 2]
    axis_deg = math.degrees(math.atan2(float(axis[1]), float(axis[0])))
    off_deg = (np.degrees(found.azimuth_rad[known]) - axis_deg + 180.0) % 360.0 - 180.0
    return {
        "unit": "m" if found.metric else "baselines",
        "is_level": result.geometry.is_level,
        "directions": [
            {
                "off_axis_deg": round(float(off), 1),
                "free": float(found.free_m[index]),
                "sigma": float(found.sigma_m[index]),
                "samples": int(found.count[index]),
            }
            for off, index in sorted(zip(off_deg, known, strict=True))
        ],
    }


def _gap(result: ParallaxResult) -> dict[str, Any] | None:
    gap = None if result.decision is None else result.decision.gap
    if gap is None:
        return None
    return {
        "free": gap.free_m,
        "sigma": gap.sigma_m,
        "width_deg": math.degrees(gap.width_rad),
        "samples": gap.count,
    }


def as_markdown(report: ParallaxReport) -> str:
    """Return the report for people, with the pictures that lie beside it."""
    detection = report.result.detection
    width, height = report.size_px
    words = [
        f"# {report.earlier} and {report.later}",
        f"**{headline(detection)}**",
        f"{width} x {height} px, method `parallax`, answer: `{kind_of(detection)}`.",
    ]
    detail = getattr(detection, "detail", "")
    if detail:
        words.append(f"Why: {detail}.")
    words += ["## What was measured", _table(("what", "figure"), _rows(report))]
    for name, file in report.pictures.items():
        words += [f"![{name}]({file})", f"*{CAPTIONS[name]}*"]
    missing = [name for name in FIGURES if name not in report.pictures]
    if missing:
        words.append(f"Not drawn, since the answer came before: {', '.join(missing)}.")
    known = [(name, text) for name, text in _STEPS if name in report.seconds]
    cost = [(text, f"{report.seconds[name] * 1e3:.1f} ms") for name, text in known]
    cost.append(("**total**", f"{sum(report.seconds.values()) * 1e3:.1f} ms"))
    words += [
        "## What each step costs",
        _table(("step", "time"), cost),
        f"Medians of {report.loops} loops.",
        *side_by_side_table.as_markdown(report.side_by_side),
    ]
    return "\n\n".join(words) + "\n"


def _rows(report: ParallaxReport) -> list[tuple[str, str]]:
    result = report.result
    counts = _samples(result)
    rows = [
        (
            "samples",
            f"{counts['grid']} on the grid, {counts['textured']} with texture, {counts['believed']} believed, {counts['tell_their_range']} tell their range",
        )
    ]
    motion = result.detection.diagnostics.motion
    if motion is not None:
        rows += _motion_rows(motion)
    contact = getattr(result.detection, "time_to_contact", None)
    if contact is not None:
        text = f"{contact.frames:.1f} +- {contact.spread_frames:.1f} steps of the pair"
        if report.interval_s is not None:
            text += f", {contact.frames * report.interval_s:.2f} +- {contact.spread_frames * report.interval_s:.2f} s"
        if report.baseline_m is not None:
            text += f", {contact.frames * report.baseline_m:.2f} m along the motion"
        rows.append(("time to contact", text))
    gap = _gap(result)
    if gap is not None and result.decision is not None:
        unit = "m" if result.decision.void_map.metric else "baselines"
        direction = result.detection
        at = (
            f" at ({direction.x_px:.0f}, {direction.y_px:.0f}) px" if isinstance(direction, Direction) else ""
        )
        rows.append(
            (
                "gap",
                f"free for {gap['free']:.1f} +- {gap['sigma']:.1f} {unit}{at}, {gap['width_deg']:.0f} degrees wide",
            )
        )
    return rows


def _motion_rows(motion: MotionEstimate) -> list[tuple[str, str]]:
    focus = "behind the camera or far outside the picture"
    if motion.focus_px is not None and motion.focus_sigma_px is not None:
        focus = f"({motion.focus_px[0]:.0f}, {motion.focus_px[1]:.0f}) +- {motion.focus_sigma_px:.0f} px"
    plane = "one plane" if motion.plane_preferred else "a scene with depth"
    return [
        ("camera", ": ".join(filter(None, (f"`{motion.intrinsics_source}`", motion.intrinsics_detail)))),
        ("rotation", f"`{motion.rotation_source}`, +- {motion.rotation_sigma_deg:.2f} degrees"),
        ("direction of travel", f"+- {motion.direction_sigma_deg:.1f} degrees"),
        ("focus of expansion", focus),
        ("flow that no rotation explains", f"{1e3 * motion.parallax_rad:.1f} mrad"),
        (
            "better explained by",
            f"{plane}; a plane explains {100.0 * motion.plane_share:.0f} % of the samples",
        ),
    ]


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]] | list[tuple[str, str]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
