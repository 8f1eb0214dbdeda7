"""``detector detect A B``: the answer to one pair of images, for people and for programs."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.results import Detection, Direction, NoDetection

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from detector.evaluation.methods import Answer
    from detector.pipeline import PairResult

ANSWER_KEYS: Final = (
    "kind",
    "x_px",
    "y_px",
    "reason",
    "detail",
    "time_to_contact_frames",
    "time_to_contact_spread_frames",
    "time_to_contact_samples",
    "time_to_contact_s",
    "time_to_contact_spread_s",
    "distance_m",
    "distance_spread_m",
    "confidence",
    "diagnostics",
)
"""Of :func:`as_dict`."""
_DESCRIPTION: Final = """\
Find the void (the way that is furthest from obstacles), or a single plane, in two frames of one camera that moved.
"""

_EPILOG: Final = f"""\
{inputs.ROTATION_HELP}
JSON keys
  kind        vanishing_point, lowest_flow, single_plane or none
  x_px, y_px  the direction, in the later frame; null unless kind is vanishing_point or lowest_flow
  reason, detail
              why there is none; else null
  time_to_contact_frames, time_to_contact_spread_frames, time_to_contact_samples
              in steps of the pair's length, counted from the later frame; null where it is not known
  time_to_contact_s, time_to_contact_spread_s
              the same in seconds at the pair's own mean speed, with --interval; else null
  distance_m, distance_spread_m
              the same in metres, with --baseline; else null
  confidence  in [0, 1], how often answers like it are right; null from a method that does not say
  diagnostics what every step found

exit code
  0  an answer, which may be "none" with its reason (frames that differ in size are none, wrong_size)
  2  the command line or a file that it names cannot be used; one line on stderr says which and why
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of ``detector``."""
    parser = commands.add_parser(
        "detect",
        help="answer for one pair of images",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("earlier", type=Path, metavar="A", help="the earlier image")
    parser.add_argument("later", type=Path, metavar="B", help="the later image")
    inputs.add_params_arguments(parser)
    inputs.add_camera_arguments(parser)
    inputs.add_rotation_argument(parser)
    parser.add_argument(
        "--baseline", type=inputs.metres, metavar="M", help="metres flown between the two frames"
    )
    parser.add_argument("--interval", type=inputs.seconds, metavar="S", help="seconds between the two frames")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="write the annotated later frame")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from detector.pipeline import VoidDetector

    params = inputs.params_of(options)
    earlier, later = inputs.read_image(options.earlier), inputs.read_image(options.later)
    camera = inputs.camera_of(options, later.shape[1], later.shape[0])
    rotation = inputs.rotation_of(options, camera)
    result = VoidDetector(params).detect(earlier, later, camera=camera, later_from_earlier=rotation)
    if options.plot is not None:
        _plot(options.plot, later, result)
    answer = as_dict(result, options.baseline, options.interval)
    print(json.dumps(answer, allow_nan=False) if options.json else _text(result, answer))
    return 0


def as_dict(
    result: PairResult, baseline_m: float | None = None, interval_s: float | None = None
) -> dict[str, Any]:
    """Return an answer as plain values that JSON can hold: the keys of ``--json``, see ``detector detect --help``.

    Parameters
    ----------
    result
        Answer of the pipeline.
    baseline_m
        Metres flown between the two frames.
    interval_s
        Seconds between them.
    """
    detection = result.detection
    direction = detection if isinstance(detection, Direction) else None
    silence = detection if isinstance(detection, NoDetection) else None
    contact = None if isinstance(detection, NoDetection) else detection.time_to_contact
    distance_m = spread_m = None
    if contact is not None and baseline_m is not None:
        distance_m, spread_m = contact.frames * baseline_m, contact.spread_frames * baseline_m
    contact_s = contact_spread_s = None
    if contact is not None and interval_s is not None:
        contact_s, contact_spread_s = contact.frames * interval_s, contact.spread_frames * interval_s
    answer = {
        "kind": kind_of(detection),
        "x_px": None if direction is None else direction.x_px,
        "y_px": None if direction is None else direction.y_px,
        "reason": None if silence is None else silence.reason.value,
        "detail": None if silence is None else silence.detail,
        "time_to_contact_frames": None if contact is None else contact.frames,
        "time_to_contact_spread_frames": None if contact is None else contact.spread_frames,
        "time_to_contact_samples": None if contact is None else contact.samples,
        "time_to_contact_s": contact_s,
        "time_to_contact_spread_s": contact_spread_s,
        "distance_m": distance_m,
        "distance_spread_m": spread_m,
        "confidence": None if isinstance(detection, NoDetection) else detection.confidence,
        "diagnostics": dataclasses.asdict(detection.diagnostics),
    }
    cleaned: dict[str, Any] = inputs.json_clean(answer)
    return cleaned


def rival_as_dict(answer: Answer) -> dict[str, Any]:
    """Return a rival's answer (:mod:`detector.evaluation.methods`) with the same keys; null what a rival does not say."""
    x_px, y_px = answer.point_px or (None, None)
    said = {"kind": answer.kind, "x_px": x_px, "y_px": y_px, "reason": answer.reason}
    cleaned: dict[str, Any] = inputs.json_clean({**dict.fromkeys(ANSWER_KEYS), **said})
    return cleaned


# ---------------------------------------------------------------------- output


def kind_of(detection: Detection) -> str:
    """Return an answer's ``kind`` as JSON has it."""
    if isinstance(detection, NoDetection):
        return "none"
    return detection.kind.value if isinstance(detection, Direction) else "single_plane"


def _text(result: PairResult, answer: dict[str, Any]) -> str:
    """Return an answer for people: what it is first, how it came about below."""
    from detector.overlay import headline

    seen = result.detection.diagnostics
    rows: list[tuple[str, str]] = []
    if answer["detail"]:
        rows.append(("why", answer["detail"]))
    if answer["distance_m"] is not None:
        rows.append(("distance", f"{answer['distance_m']:.2f} +- {answer['distance_spread_m']:.2f} m"))
    if answer["time_to_contact_s"] is not None:
        rows.append(
            ("contact", f"{answer['time_to_contact_s']:.2f} +- {answer['time_to_contact_spread_s']:.2f} s")
        )
    if seen.n_features_earlier:
        rows.append(("key points", f"{seen.n_features_earlier} earlier, {seen.n_features_later} later"))
    if seen.n_tracks:
        filtered = f"N' {seen.n_after_distribution}, N'' {seen.n_after_length}, N''' {seen.n_after_angle}"
        rows.append(("flow vectors", f"N {seen.n_tracks}, {filtered}"))
    if seen.n is not None:
        rows.append(("clusters", f"p {seen.p}, n {seen.n}, k {seen.k}"))
    if seen.plane_statistic is not None:
        rows.append(("single plane", f"{seen.plane_statistic:.3g} against {seen.plane_threshold:.3g}"))
    if seen.n_lines:
        passed = f"{len(seen.lines_px)} of {seen.n_lines} by their angle"
        rows.append(("lines", f"{passed}, {len(seen.candidates_px)} vanishing-point candidates"))
    if seen.seconds:
        rows.append(("time", f"{sum(seen.seconds.values()) * 1e3:.0f} ms"))
    return "\n".join([headline(result.detection), *(f"  {name:<13} {value}" for name, value in rows)])


def _plot(path: Path, later: NDArray[np.uint8], result: PairResult) -> None:
    from detector.overlay import draw, legible_zoom

    inputs.write_picture("--plot", path, draw(later, result, zoom=legible_zoom(later.shape[1])))
