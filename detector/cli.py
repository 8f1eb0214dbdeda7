"""Command line of the detector: ``detector detect A B``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraError, CameraModel
from detector.overlay import caption, draw
from detector.params import DetectorParams, ParamsError
from detector.pipeline import PairResult, VoidDetector
from detector.results import Detection, Direction, NoDetection

_EPILOG = """\
The rotation file holds the 3 x 3 rotation that takes coordinates of the earlier camera to those of the later one
(x right, y down, z forward), as TOML or JSON:
    later_from_earlier = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
It needs --hfov or --camera. In JSON the bare 3 x 3 list will do.

Exit code 0: an answer, which may be "none" with its reason (frames of different sizes are "none: wrong_size");
2: the command or a file cannot be used.
"""


class InputError(Exception):
    """The command line or a file that it names cannot be used; the message is for the user."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 0, or 2 with one clear message on stderr."""
    options = _parser().parse_args(argv)
    try:
        return _detect(options)
    except (InputError, ParamsError, CameraError) as error:
        print(f"detector: {error}", file=sys.stderr)
        return 2


def as_dict(result: PairResult, baseline_m: float | None = None) -> dict[str, Any]:
    """Return the answer as plain values, the keys of ``--json``.

    Parameters
    ----------
    result
        Answer of the pipeline.
    baseline_m
        Metres flown between the frames; adds ``distance_m`` where a time to contact is known.
    """
    detection = result.detection
    direction = detection if isinstance(detection, Direction) else None
    contact = None if isinstance(detection, NoDetection) else detection.time_to_contact
    answer: dict[str, Any] = {
        "kind": _kind(detection),
        "x_px": None if direction is None else direction.x_px,
        "y_px": None if direction is None else direction.y_px,
        "reason": detection.reason.value if isinstance(detection, NoDetection) else None,
        "detail": detection.detail if isinstance(detection, NoDetection) else None,
        "time_to_contact_frames": None if contact is None else contact.frames,
        "time_to_contact_spread_frames": None if contact is None else contact.spread_frames,
        "time_to_contact_samples": None if contact is None else contact.samples,
    }
    if baseline_m is not None:
        answer["distance_m"] = None if contact is None else contact.frames * baseline_m
        answer["distance_spread_m"] = None if contact is None else contact.spread_frames * baseline_m
    answer["diagnostics"] = dataclasses.asdict(detection.diagnostics)
    return answer


def _kind(detection: Detection) -> str:
    if isinstance(detection, NoDetection):
        return "none"
    return detection.kind.value if isinstance(detection, Direction) else "single_plane"


def _detect(options: argparse.Namespace) -> int:
    earlier, later = _read_image(options.earlier), _read_image(options.later)
    if options.params is None:
        params = DetectorParams.preset(options.preset)
    else:
        params = DetectorParams.from_toml(options.params, options.preset)
    camera: CameraModel | None = None
    if options.camera is not None:
        camera = CameraModel.from_file(options.camera)
    elif options.hfov is not None:
        if min(later.shape) < 16:
            raise InputError(
                f"{options.later}: {later.shape[1]} x {later.shape[0]} px is too small for a camera"
            )
        camera = CameraModel.from_hfov(later.shape[1], later.shape[0], options.hfov)
    rotation: NDArray[np.float64] | None = None
    if options.rotation is not None:
        if camera is None:
            raise InputError("--rotation needs --hfov or --camera")
        rotation = _read_rotation(options.rotation)
    result = VoidDetector(params).detect(earlier, later, camera=camera, later_from_earlier=rotation)
    answer = as_dict(result, options.baseline)
    if options.plot is not None:
        _write_image(options.plot, draw(later, result.detection, result.tracks))
    print(json.dumps(answer, allow_nan=False) if options.json else _text(result, answer))
    return 0


def _text(result: PairResult, answer: dict[str, Any]) -> str:
    diagnostics = result.detection.diagnostics
    rows = [caption(result.detection)]
    if answer["detail"]:
        rows.append(f"  {answer['detail']}")
    if answer.get("distance_m") is not None:
        rows.append(f"  distance {answer['distance_m']:.2f} +- {answer['distance_spread_m']:.2f} m")
    rows.append(f"  key points {diagnostics.n_features_earlier}, {diagnostics.n_features_later}")
    rows.append(
        f"  flow vectors N {diagnostics.n_tracks}, N' {diagnostics.n_after_distribution}, "
        f"N'' {diagnostics.n_after_length}, N''' {diagnostics.n_after_angle}"
    )
    if diagnostics.n is not None and diagnostics.plane_statistic is not None:
        rows.append(f"  p {diagnostics.p}, n {diagnostics.n}, k {diagnostics.k}")
        rows.append(
            f"  single plane: {diagnostics.plane_statistic:.2f} against {diagnostics.plane_threshold:.2f}"
        )
        rows.append(f"  lines {len(diagnostics.lines_px)}, candidates {len(diagnostics.candidates_px)}")
    times = ", ".join(f"{name} {seconds * 1e3:.0f}" for name, seconds in diagnostics.seconds.items())
    if times:
        rows.append(f"  ms: {times}")
    return "\n".join(rows)


def _read_image(path: Path) -> NDArray[np.uint8]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    except cv2.error as error:  # a header that promises absurd sizes
        raise InputError(f"{path}: not an image that can be decoded") from error
    if image is None:
        raise InputError(f"{path}: not an image that can be decoded")
    return np.asarray(image, np.uint8)


def _write_image(path: Path, picture: NDArray[np.uint8]) -> None:
    try:
        encoded, data = cv2.imencode(path.suffix or ".png", picture)
    except cv2.error as error:
        raise InputError(f"{path}: no image format for {path.suffix!r}, try .png") from error
    if not encoded:
        raise InputError(f"{path}: cannot be encoded")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _read_rotation(path: Path) -> NDArray[np.float64]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file in UTF-8") from error
    try:
        found: Any = json.loads(text) if text.lstrip()[:1] in ("{", "[") else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path}: neither valid TOML nor JSON: {error}") from error
    if isinstance(found, dict):
        if set(found) != {"later_from_earlier"}:
            raise InputError(f"{path}: found keys {sorted(found)}, allowed is later_from_earlier alone")
        found = found["later_from_earlier"]
    try:
        rotation = np.array(found, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: later_from_earlier: found {found!r}, allowed is a 3 x 3 list of numbers"
        ) from error
    if rotation.shape != (3, 3):
        raise InputError(f"{path}: later_from_earlier: found shape {rotation.shape}, allowed is 3 x 3")
    if not np.isfinite(rotation).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise InputError(
            f"{path}: later_from_earlier: found a matrix that is not orthonormal, allowed is a rotation"
        )
    if np.linalg.det(rotation) < 0.0:
        raise InputError(f"{path}: later_from_earlier: found a reflection, allowed is a rotation")
    return rotation


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed is a number of metres") from None
    if not 0.0 < value < 1000.0:
        raise argparse.ArgumentTypeError(f"found {text}, allowed are more than 0 and less than 1000 m")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="detector", description="Void detection from two frames of one camera."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    detect = commands.add_parser(
        "detect",
        help="answer for one pair of images",
        description="Find the void, or a single plane, in one pair of images.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    detect.add_argument("earlier", type=Path, metavar="A", help="the earlier image")
    detect.add_argument("later", type=Path, metavar="B", help="the later image, of the same size")
    detect.add_argument(
        "--params", type=Path, metavar="FILE", help="TOML with parameters that replace the preset's"
    )
    detect.add_argument(
        "--preset", default="default", metavar="NAME", help="default or paper (default: default)"
    )
    known = detect.add_mutually_exclusive_group()
    known.add_argument("--hfov", type=float, metavar="DEG", help="horizontal field of view")
    known.add_argument("--camera", type=Path, metavar="FILE", help="camera file (TOML)")
    detect.add_argument(
        "--rotation", type=Path, metavar="FILE", help="rotation between the frames, see below"
    )
    detect.add_argument("--baseline", type=_positive, metavar="M", help="metres flown between the frames")
    detect.add_argument("--json", action="store_true", help="one JSON object on stdout")
    detect.add_argument("--plot", type=Path, metavar="OUT.png", help="write the annotated second frame")
    return parser
