"""``detector detect A B``: the answer to one pair of images, for people and for programs."""

from __future__ import annotations

import argparse
import dataclasses
import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.commands.inputs import InputError
from detector.results import Detection, Direction, NoDetection

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from detector.pipeline import PairResult

_DESCRIPTION: Final = """\
Find the void (the way that is furthest from obstacles), or a single plane, in two frames of one camera that moved.
"""

_EPILOG: Final = """\
rotation file
  The 3 x 3 rotation that takes coordinates of the earlier camera to those of the later one (x right, y down,
  z forward), as TOML
      later_from_earlier = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
  or as JSON
      {"later_from_earlier": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  With camera-to-world rotations Ra and Rb it is transpose(Rb) Ra. It needs --hfov or --camera.

JSON keys
  kind        vanishing_point, lowest_flow, single_plane or none
  x_px, y_px  the direction, in the later frame; null unless kind is vanishing_point or lowest_flow
  reason, detail
              why there is none; else null
  time_to_contact_frames, time_to_contact_spread_frames, time_to_contact_samples
              in steps of the pair's length, counted from the later frame; null where it is not known
  distance_m, distance_spread_m
              the same in metres, with --baseline; else null
  diagnostics what every step found

exit code
  0  an answer, which may be "none" with its reason (frames that differ in size are none, wrong_size)
  2  the command line or a file that it names cannot be used; one line on stderr says which and why
"""

_LEGIBLE_WIDTH_PX: Final = 480
"""Narrower frames are plotted enlarged: text at their own size could not be read."""
_ROTATION_TOLERANCE: Final = 1e-3
"""Files hold rounded figures: R transpose(R) may differ from the identity by this much."""
_LARGE: Final = 1e6
"""No entry of anything like a rotation is as large; NaN and whole numbers too long for a float fail the comparison too."""
_MAX_ZOOM: Final = 8


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
    parser.add_argument(
        "--rotation", type=Path, metavar="FILE", help="known rotation between the frames, see below"
    )
    parser.add_argument(
        "--baseline", type=inputs.metres, metavar="M", help="metres flown between the two frames"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="write the annotated later frame")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from detector.pipeline import VoidDetector

    params = inputs.params_of(options)
    earlier, later = inputs.read_image(options.earlier), inputs.read_image(options.later)
    camera, rotation = inputs.camera_of(options, later.shape[1], later.shape[0]), None
    if options.rotation is not None:
        if options.hfov is None and options.camera is None:
            raise InputError("--rotation: needs the camera too, as --hfov DEG or --camera FILE")
        given = _read_rotation(options.rotation)
        rotation = None if camera is None else given
    result = VoidDetector(params).detect(earlier, later, camera=camera, later_from_earlier=rotation)
    if options.plot is not None:
        _plot(options.plot, later, result)
    answer = as_dict(result, options.baseline)
    print(json.dumps(answer, allow_nan=False) if options.json else _text(result, answer))
    return 0


def as_dict(result: PairResult, baseline_m: float | None = None) -> dict[str, Any]:
    """Return an answer as plain values that JSON can hold: the keys of ``--json``, see ``detector detect --help``.

    Parameters
    ----------
    result
        Answer of the pipeline.
    baseline_m
        Metres flown between the two frames.
    """
    detection = result.detection
    direction = detection if isinstance(detection, Direction) else None
    silence = detection if isinstance(detection, NoDetection) else None
    contact = None if isinstance(detection, NoDetection) else detection.time_to_contact
    distance_m = spread_m = None
    if contact is not None and baseline_m is not None:
        distance_m, spread_m = contact.frames * baseline_m, contact.spread_frames * baseline_m
    answer = {
        "kind": kind_of(detection),
        "x_px": None if direction is None else direction.x_px,
        "y_px": None if direction is None else direction.y_px,
        "reason": None if silence is None else silence.reason.value,
        "detail": None if silence is None else silence.detail,
        "time_to_contact_frames": None if contact is None else contact.frames,
        "time_to_contact_spread_frames": None if contact is None else contact.spread_frames,
        "time_to_contact_samples": None if contact is None else contact.samples,
        "distance_m": distance_m,
        "distance_spread_m": spread_m,
        "diagnostics": dataclasses.asdict(detection.diagnostics),
    }
    cleaned: dict[str, Any] = inputs.json_clean(answer)
    return cleaned


# ---------------------------------------------------------------------- input


def _read_rotation(path: Path) -> NDArray[np.float64]:
    import numpy as np

    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {inputs.cause(error)}") from error
    try:
        table: Any = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(inputs.one_line(f"{path}: is not valid TOML or JSON: {error}")) from error
    if set(table) != {"later_from_earlier"}:
        found = ", ".join(sorted(table)) or "no key"
        raise InputError(inputs.one_line(f"{path}: found {found}, allowed is later_from_earlier alone"))
    rows = table["later_from_earlier"]
    is_matrix = isinstance(rows, list) and len(rows) == 3 and all(_is_row(row) for row in rows)
    if not is_matrix:
        raise InputError(
            f"{path}: later_from_earlier: found {inputs.short(rows)}, allowed are 3 rows of 3 numbers"
        )
    rotation = np.array(rows, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not off <= _ROTATION_TOLERANCE:
        raise InputError(
            f"{path}: later_from_earlier: is not a rotation: rows must be of length 1 and perpendicular, they are off by {off:.3g}"
        )
    if np.linalg.det(rotation) < 0.0:
        raise InputError(f"{path}: later_from_earlier: is a reflection, its determinant must be +1")
    return rotation


def _is_row(row: object) -> bool:
    return (
        isinstance(row, list)
        and len(row) == 3
        and all(
            isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGE
            for value in row
        )
    )


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
    from detector.overlay import draw

    zoom = min(max(1, round(_LEGIBLE_WIDTH_PX / later.shape[1])), _MAX_ZOOM)
    inputs.write_picture("--plot", path, draw(later, result, zoom=zoom))
