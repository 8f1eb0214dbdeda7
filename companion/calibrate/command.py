"""``companion calibrate``: views of a board from a camera, a video or a folder, to a camera file."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Sequence
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ValidationError

from companion.calibrate.board import Board, View, board_from_words
from companion.calibrate.collect import ViewCollector
from companion.calibrate.files import camera_file, coverage_picture
from companion.calibrate.judge import Judgement, doubts, judge, judge_existing
from companion.calibrate.solve import Calibration, calibrate, coverage, view_errors_px
from companion.cameras import write_image
from companion.clock import RealClock
from companion.config import LogConfig, SourceConfig
from companion.config_overlay import replace_file
from companion.errors import CompanionError, ConfigError, SourceError
from companion.frames.open import open_source
from companion.log import open_log
from detector.camera_model import CameraError, CameraModel

_PATIENCE_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Seen:
    """The views that were collected, and the size of their images."""

    views: tuple[View, ...]
    width_px: int
    height_px: int
    images: int


def calibrate_parser() -> argparse.ArgumentParser:
    """Return the command line of ``companion calibrate``."""
    parser = argparse.ArgumentParser(
        prog="companion calibrate",
        description="Hold a flat board before the camera: everywhere in the image, near and far, tilted 30 to 45 degrees each way, and still each time.",
    )
    parser.add_argument(
        "source",
        nargs="?",
        metavar="SOURCE",
        help="a camera (any source.url, or /dev/video0), a video, or a folder of images",
    )
    parser.add_argument(
        "--board",
        default="9x6",
        help="inner corners of a chessboard, or squares of a ChArUco board (default: 9x6)",
    )
    parser.add_argument("--square", default="24mm", help="side of a square (default: 24mm)")
    parser.add_argument(
        "--charuco", default="", metavar="DICTIONARY", help="the board has markers, such as 4X4_50"
    )
    parser.add_argument("--marker", default="", metavar="SIDE", help="side of a marker, such as 18mm")
    parser.add_argument(
        "-o",
        "--output",
        default="camera.toml",
        metavar="FILE.toml",
        help="camera file to write (default: camera.toml)",
    )
    parser.add_argument(
        "--picture",
        default="",
        metavar="OUT.png",
        help="picture of the coverage (default: beside the camera file)",
    )
    parser.add_argument(
        "--views", type=int, default=25, help="camera or video: views to collect (default: 25)"
    )
    parser.add_argument(
        "--seconds", type=float, default=180.0, help="camera: give up after this long (default: 180)"
    )
    parser.add_argument("--check", metavar="FILE.toml", help="judge this camera file instead of making one")
    parser.add_argument(
        "--size", metavar="WxH", default="", help="camera: size, which must be the one that flies"
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    """Run the command; 0 where the camera file can be flown with."""
    result = check(arguments) if arguments.check else make(arguments)
    sys.stdout.write(
        json.dumps(result) + "\n" if arguments.json else "".join(f"{line}\n" for line in _lines(result))
    )
    return 1 if result["grade"] == "bad" else 0


def make(arguments: argparse.Namespace) -> dict[str, object]:
    """Calibrate, and write the camera file unless it came out bad; return what there is to say.

    Raises
    ------
    companion.errors.CompanionError
        When the source, the board or the views are not right.
    """
    if not arguments.source:
        raise CompanionError(
            "SOURCE is missing: a camera, a video or a folder of images with the board in them"
        )
    board = board_from_words(arguments.board, arguments.square, arguments.charuco, arguments.marker)
    shown = _source_config(arguments).shown_url
    seen = asyncio.run(collected(arguments, board))
    found = calibrate(seen.views, seen.width_px, seen.height_px)
    covered = coverage(found.used, seen.width_px, seen.height_px)
    judgement = judge(found, covered)
    path = Path(arguments.output)
    picture = Path(arguments.picture) if arguments.picture else path.with_suffix(".png")
    errors_px = [view_errors_px(found.model, view) for view in found.used]
    write_image(picture, coverage_picture(found.model, found.used, errors_px, covered))
    written = judgement.grade != "bad"
    if written:
        try:
            text = camera_file(found, covered, judgement, shown)
            if path.is_file() or not path.exists():
                replace_file(path, text.encode())  # a full disk must not cost the camera file that is there
            else:
                path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise CompanionError(f"{path}: cannot be written: {error.strerror}") from error
    return {
        "grade": judgement.grade,
        "file": str(path) if written else None,
        "picture": str(picture),
        "images": seen.images,
        "views": len(found.used),
        "left_out": found.left_out,
        "rms_px": round(found.rms_px, 4),
        "focal_sigma": round(found.focal_sigma, 6),
        "coverage": round(covered.fraction, 3),
        "hfov_deg": round(float(np.degrees(found.model.hfov_rad)), 3),
        "advice": [*judgement.advice, *doubts(found.model)],
    }


def check(arguments: argparse.Namespace) -> dict[str, object]:
    """Judge a camera file, by its figures alone or by the board in a source; return what there is to say.

    Raises
    ------
    companion.errors.CompanionError
        When the file, the source or the board are not right.
    """
    try:
        model = CameraModel.from_file(arguments.check)
    except CameraError as error:
        raise CompanionError(str(error)) from error
    advice = doubts(model)
    result: dict[str, object] = {
        "file": arguments.check,
        "hfov_deg": round(float(np.degrees(model.hfov_rad)), 3),
    }
    if not arguments.source:
        return {"grade": "usable" if advice else "good", **result, "advice": list(advice)}
    board = board_from_words(arguments.board, arguments.square, arguments.charuco, arguments.marker)
    seen = asyncio.run(collected(arguments, board))
    if not seen.views:
        raise CompanionError(f"{arguments.source}: the board was found in none of {seen.images} images")
    if abs((seen.width_px / seen.height_px) / (model.width_px / model.height_px) - 1.0) > 0.01:
        raise CompanionError(
            f"{arguments.source}: images of {seen.width_px} x {seen.height_px} px, the camera file is for "
            f"{model.width_px} x {model.height_px}: another mode of the camera, with another field of view"
        )
    model = model.scaled_to(seen.width_px, seen.height_px)
    covered = coverage(seen.views, seen.width_px, seen.height_px)
    errors_px = [view_errors_px(model, view) for view in seen.views]
    judgement: Judgement = judge_existing(model, np.concatenate(errors_px), covered, _anew(seen))
    if arguments.picture:
        write_image(Path(arguments.picture), coverage_picture(model, seen.views, errors_px, covered))
    return {
        "grade": judgement.grade,
        **result,
        "picture": arguments.picture or None,
        "images": seen.images,
        "views": len(seen.views),
        "rms_px": round(float(np.sqrt(np.mean(np.concatenate(errors_px) ** 2))), 4),
        "coverage": round(covered.fraction, 3),
        "advice": [*judgement.advice, *advice],
    }


def _anew(seen: Seen) -> Calibration | None:
    try:
        return calibrate(seen.views, seen.width_px, seen.height_px)
    except CompanionError:  # too few views, or too much alike: then the errors alone have to do
        return None


async def collected(arguments: argparse.Namespace, board: Board) -> Seen:
    """Collect views from the source: all of a folder, different ones of a video, different and still ones of a camera.

    Raises
    ------
    companion.errors.CompanionError
        When the source is not right or delivers nothing.
    """
    config = _source_config(arguments)
    is_folder = _is_folder(config)
    wanted = 10_000 if is_folder else arguments.views
    clock = RealClock()
    collector: ViewCollector | None = None
    shape = (0, 0)
    images = 0
    with open_log(LogConfig(level="warning")) as log:
        async with open_source(config, clock=clock, log=log) as source, aclosing(source.frames()) as frames:
            until_ns = clock.now_ns() + round(arguments.seconds * 1e9)
            while collector is None or len(collector.views) < wanted:
                try:
                    async with asyncio.timeout(_PATIENCE_S):
                        frame = await anext(frames, None)
                except TimeoutError as error:
                    raise SourceError(f"{config.shown_url}: no frame within {_PATIENCE_S:g} s") from error
                if frame is None or (config.scheme != "file" and clock.now_ns() > until_ns):
                    break
                images += 1
                if collector is None:
                    shape = (frame.image.shape[1], frame.image.shape[0])
                    collector = ViewCollector(shape[0], needs_stillness=config.scheme != "file")
                view = board.find(np.ascontiguousarray(frame.image))
                if is_folder:
                    collector.views += [view] if view is not None else []
                elif collector.offer(view):
                    _tell(collector.views, wanted, *shape)
    return Seen(tuple(collector.views) if collector else (), *shape, images)


def _is_folder(config: SourceConfig) -> bool:
    return config.scheme == "file" and Path(config.where).is_dir()


def _tell(views: Sequence[View], wanted: int, width_px: int, height_px: int) -> None:
    seen = coverage(views, width_px, height_px)
    sys.stderr.write(
        f"view {len(views)} of {wanted}; {seen.fraction:.0%} of the image seen; next: {seen.emptiest_place}\n"
    )


def _source_config(arguments: argparse.Namespace) -> SourceConfig:
    source: str = arguments.source
    width, _, height = arguments.size.lower().partition("x")
    if arguments.size and not (width.isdecimal() and height.isdecimal()):
        raise ConfigError(f"--size: found {arguments.size!r}; allowed: WIDTHxHEIGHT, such as 640x480")
    if not 6 <= arguments.views <= 1000:
        raise ConfigError(f"--views: found {arguments.views}; allowed: 6 to 1000")
    if source.startswith("/dev/"):
        source = f"v4l2:{source}"
    elif Path(source).exists():
        source = f"file:{source}"
    try:
        return SourceConfig(
            url=source, playback="fastest", width_px=int(width or 0), height_px=int(height or 0)
        )
    except ValidationError as error:
        raise ConfigError(f"{arguments.source}: no such file or folder, and no source.url") from error


def _lines(result: dict[str, object]) -> list[str]:
    words = [
        f"{key} {value}"
        for key, value in result.items()
        if key not in ("grade", "advice") and value is not None
    ]
    advice = result["advice"]
    return [
        f"{result['grade']}: {', '.join(words)}",
        *(f"  {line}" for line in (advice if isinstance(advice, list) else [])),
    ]
