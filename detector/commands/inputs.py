"""What the commands take from their command line, and what they say when it cannot be used."""

from __future__ import annotations

import argparse
import json
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from detector.camera_model import CameraModel
    from detector.params import DetectorParams

_MAX_BASELINE_M: Final = 1000.0
_MAX_INTERVAL_S: Final = 3600.0
_ROTATION_TOLERANCE: Final = 1e-3
"""Files hold rounded figures: R transpose(R) may differ from the identity by this much."""
_LARGE: Final = 1e6
"""No entry of anything like a rotation is as large; NaN and whole numbers too long for a float fail the comparison too."""

ROTATION_HELP: Final = """\
rotation file
  The 3 x 3 rotation that takes coordinates of the earlier camera to those of the later one (x right, y down,
  z forward), as TOML
      later_from_earlier = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
  or as JSON
      {"later_from_earlier": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  With camera-to-world rotations Ra and Rb it is transpose(Rb) Ra. It needs --hfov or --camera.
"""
"""What ``--help`` says of ``--rotation``."""


class InputError(Exception):
    """The command line, or a file that it names, cannot be used; the message is one line for the user."""


def add_params_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--preset`` and ``--params``; :func:`params_of` reads them."""
    parser.add_argument(
        "--preset", default="default", metavar="NAME", help="default or paper (default: %(default)s)"
    )
    parser.add_argument(
        "--params", type=Path, metavar="FILE", help="TOML file with parameters that replace the preset's"
    )


def add_camera_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--hfov`` and ``--camera``; :func:`camera_of` reads them."""
    cameras = parser.add_mutually_exclusive_group()
    cameras.add_argument(
        "--hfov", type=float, metavar="DEG", help="horizontal field of view of a camera without distortion"
    )
    cameras.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="TOML camera file: width_px, height_px, and hfov_deg or fx_px, fy_px, cx_px, cy_px, distortion",
    )


def add_rotation_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--rotation``; :func:`rotation_of` reads it, :data:`ROTATION_HELP` describes it."""
    parser.add_argument(
        "--rotation", type=Path, metavar="FILE", help="known rotation between the frames, see below"
    )


def params_of(options: argparse.Namespace) -> DetectorParams:
    """Return the parameters that ``--preset`` and ``--params`` ask for.

    Raises
    ------
    InputError
        They cannot be used.
    """
    from detector.params import DetectorParams, ParamsError

    try:
        if options.params is None:
            return DetectorParams.preset(options.preset)
        return DetectorParams.from_toml(options.params, options.preset)
    except ParamsError as error:
        raise InputError(one_line(error)) from error


def methods_of(option: str, texts: Sequence[str]) -> tuple[str, ...]:
    """Return the methods that an option names, in their order: each text one name, or several with commas between.

    Raises
    ------
    InputError
        One is not known, or named twice.
    """
    from detector.evaluation.methods import METHODS

    names = tuple(name.strip() for text in texts for name in text.split(","))
    for name in names:
        if name not in METHODS:
            raise InputError(f"{option}: found {short(name)}, allowed are {', '.join(METHODS)}")
        if names.count(name) > 1:
            raise InputError(f"{option}: found {name} {names.count(name)} times, allowed is once")
    return names


def camera_of(options: argparse.Namespace, width_px: int, height_px: int) -> CameraModel | None:
    """Return the camera that ``--hfov`` or ``--camera`` describes, scaled to the frames where they have its shape.

    None where none is described, and for a frame too small for any camera, whose answer is wrong_size in any case.

    Raises
    ------
    InputError
        The camera cannot be used.
    """
    from detector.camera_model import CameraError, CameraModel

    try:
        if options.hfov is not None:
            least_px = 16  # of a camera's side
            camera = CameraModel.from_hfov(max(width_px, least_px), max(height_px, least_px), options.hfov)
            return camera if min(width_px, height_px) >= least_px else None
        if options.camera is None:
            return None
        camera = CameraModel.from_file(options.camera)
        same_shape = abs(width_px * camera.height_px - height_px * camera.width_px) <= max(camera.width_px, 1)
        if same_shape and (width_px, height_px) != (camera.width_px, camera.height_px):
            return camera.scaled_to(width_px, height_px)
    except CameraError as error:
        prefix = "--hfov: " if options.hfov is not None else ""
        raise InputError(one_line(f"{prefix}{error}")) from error
    return camera


def rotation_of(options: argparse.Namespace, camera: CameraModel | None) -> NDArray[np.float64] | None:
    """Return the rotation that ``--rotation`` names; None where there is none, or no camera to use it with.

    Raises
    ------
    InputError
        It cannot be used, or neither ``--hfov`` nor ``--camera`` is given.
    """
    if options.rotation is None:
        return None
    if options.hfov is None and options.camera is None:
        raise InputError("--rotation: needs the camera too, as --hfov DEG or --camera FILE")
    given = read_rotation(options.rotation)
    return None if camera is None else given


def read_rotation(path: Path) -> NDArray[np.float64]:
    """Return the rotation ``later_from_earlier`` that a TOML or JSON file holds, (3, 3).

    Raises
    ------
    InputError
        The file cannot be read, or holds no rotation.
    """
    import numpy as np

    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {cause(error)}") from error
    try:
        table: Any = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(one_line(f"{path}: is not valid TOML or JSON: {error}")) from error
    if set(table) != {"later_from_earlier"}:
        found = ", ".join(sorted(table)) or "no key"
        raise InputError(one_line(f"{path}: found {found}, allowed is later_from_earlier alone"))
    rows = table["later_from_earlier"]
    is_matrix = isinstance(rows, list) and len(rows) == 3 and all(_is_row(row) for row in rows)
    if not is_matrix:
        raise InputError(f"{path}: later_from_earlier: found {short(rows)}, allowed are 3 rows of 3 numbers")
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


def read_image(path: Path) -> NDArray[np.uint8]:
    """Return an image file as grey (H, W) uint8.

    Raises
    ------
    InputError
        It cannot be read or decoded.
    """
    import cv2
    import numpy as np

    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: cannot be read: {cause(error)}") from error
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    except cv2.error as error:  # a header that promises absurd sizes
        raise InputError(f"{path}: is not an image that can be decoded") from error
    if image is None:
        raise InputError(f"{path}: is not an image that can be decoded")
    return np.asarray(image, np.uint8)


def metres(text: str) -> float:
    """Read metres from a command line, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= _MAX_BASELINE_M:
        raise argparse.ArgumentTypeError(
            f"found {text!r}, allowed are metres above 0 and up to {_MAX_BASELINE_M:g}"
        )
    return value


def seconds(text: str) -> float:
    """Read seconds from a command line, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= _MAX_INTERVAL_S:
        raise argparse.ArgumentTypeError(
            f"found {text!r}, allowed are seconds above 0 and up to {_MAX_INTERVAL_S:g}"
        )
    return value


def write_picture(option: str, path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an image in the format that the file's name asks for.

    Raises
    ------
    InputError
        The format is unknown or the file cannot be written; the message names ``option``.
    """
    import cv2

    try:
        done, data = cv2.imencode(path.suffix, picture)
    except cv2.error as error:
        raise InputError(
            f"{option} {path}: found the ending {path.suffix!r}, allowed is an image format such as .png"
        ) from error
    if not done:
        raise InputError(f"{option} {path}: the picture cannot be encoded as {path.suffix}")
    try:
        path.write_bytes(data.tobytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{option} {path}: cannot be written: {cause(error)}") from error


def check_picture_path(option: str, path: Path) -> None:
    """Say before long work that :func:`write_picture` would fail after it.

    Raises
    ------
    InputError
        The folder is not there, or no image format has this ending.
    """
    import cv2

    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: {path.parent} is not a folder")
    if not cv2.haveImageWriter(f"picture{path.suffix}"):
        raise InputError(
            f"{option} {path}: found the ending {path.suffix!r}, allowed is an image format such as .png"
        )


def json_clean(value: Any) -> Any:
    """Return the value with lists for tuples and null for figures that are not finite, which JSON has no word for."""
    if isinstance(value, dict):
        return {key: json_clean(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_clean(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def cause(error: Exception) -> str:
    """Return why a file could not be used, in one line."""
    return (error.strerror if isinstance(error, OSError) else None) or one_line(error)


def one_line(message: object) -> str:
    """Return a message without its line breaks."""
    return "; ".join(part.strip() for part in str(message).splitlines() if part.strip())


def short(value: object, limit: int = 60) -> str:
    """Return a value as text of limited length."""
    text = repr(value)
    return text if len(text) <= limit else f"{text[:limit]}..."
