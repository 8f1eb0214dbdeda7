"""``detector report A B -o DIR``: how the answer to one pair came about, in the figures and tables of the paper, or in those of the parallax method."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.commands.inputs import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from detector.evaluation.side_by_side import KnownPair

_DESCRIPTION: Final = """\
Show how the answer to one pair of images came about. Method paper: the paper's Figs. 3 to 6 as PNG, its Tables 1 and 2 as
Markdown and JSON. Method parallax: flow with its uncertainty, ranges, and the void map over the image and from above.
Both: what every method and rival says of the pair, side by side, and which of them is right where a groundtruth.json beside
the images knows.
"""

_EPILOG: Final = f"""\
{inputs.ROTATION_HELP}
files written into DIR
  report.md    tables, figures and the answer, for people
  report.json  the same figures for programs; docs/report.md says what each key is
with --method paper
  figure-3.png flow before and after the filters, and what each filter dropped
  figure-4.png the length and angular filters, and what p, n and k were chosen by
  figure-5.png clusters by magnitude, and the LMCC
  figure-6.png lines, vanishing-point candidates and the direction
with --method parallax
  flow.png     flow with its uncertainty, the rotation taken out, and the focus of expansion
  ranges.png   what each sample says of its range
  map.png      the void map along the horizon of the later frame
  polar.png    the void map from above
  A figure is left out where the answer came before its step; one of an earlier run is then removed.

exit code
  0  written, also where the answer is "none"
  2  the command line or a file that it names cannot be used; one line on stderr says which and why
"""

_PAPER_FIGURES: Final = ("figure-3", "figure-4", "figure-5", "figure-6")
_PARALLAX_FIGURES: Final = ("flow", "ranges", "map", "polar")
_MAX_LOOPS: Final = 1000
_MOST_M: Final = 1000.0


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of ``detector``."""
    parser = commands.add_parser(
        "report",
        help="how the answer for one pair came about: figures and tables",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("earlier", type=Path, metavar="A", help="the earlier image")
    parser.add_argument("later", type=Path, metavar="B", help="the later image")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder to write into; made where missing",
    )
    parser.add_argument(
        "--method",
        choices=("paper", "parallax"),
        default="paper",
        help="whose answer (default: %(default)s)",
    )
    inputs.add_params_arguments(parser)
    inputs.add_camera_arguments(parser)
    inputs.add_rotation_argument(parser)
    parser.add_argument(
        "--translation",
        nargs=3,
        type=_coordinate,
        metavar=("X", "Y", "Z"),
        help="with --method parallax: metres from the earlier to the later camera, in the earlier camera's axes (x right, y down, z forward); needs --rotation",
    )
    parser.add_argument(
        "--interval",
        type=inputs.seconds,
        metavar="S",
        help="with --method parallax: seconds between the two images",
    )
    parser.add_argument(
        "--loops", type=_loops, default=5, metavar="N", help="loops timed of each kind (default: %(default)s)"
    )
    parser.add_argument(
        "--no-truth", action="store_true", help="leave a groundtruth.json beside the images aside"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    if options.method == "parallax":
        return _run_parallax(options)
    for name in ("translation", "interval"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name}: only with --method parallax")
    from detector.commands.report_document import Report, as_json, as_markdown
    from detector.commands.side_by_side_table import side_by_side
    from detector.drawing.figures import figures
    from detector.evaluation.methods import PairInput
    from detector.report import Pair, cost_of_loops, examine

    params = inputs.params_of(options)
    earlier, later = inputs.read_image(options.earlier), inputs.read_image(options.later)
    camera = inputs.camera_of(options, later.shape[1], later.shape[0])
    pair = Pair(earlier, later, camera, inputs.rotation_of(options, camera))
    known = _known(options, later)
    _make(options.output)
    steps = examine(pair, params)
    first, other = cost_of_loops(pair, params, loops=options.loops)
    report = Report(
        earlier=options.earlier.name,
        later=options.later.name,
        size_px=(later.shape[1], later.shape[0]),
        preset=options.preset,
        steps=steps,
        first=first,
        other=other,
        loops=options.loops,
        pictures=_write_pictures(options.output, figures(pair, steps, params)),
        side_by_side=side_by_side(
            PairInput(earlier, later, camera, pair.later_from_earlier), params, known, options.loops
        ),
    )
    return _write_report(options.output, as_json(report), as_markdown(report))


def _run_parallax(options: argparse.Namespace) -> int:
    import numpy as np

    from detector.commands.parallax_report import (
        ParallaxPair,
        ParallaxReport,
        as_json,
        as_markdown,
        examine,
    )
    from detector.commands.side_by_side_table import side_by_side
    from detector.drawing.parallax_figures import figures
    from detector.evaluation.methods import PairInput

    params = inputs.params_of(options)
    earlier, later = inputs.read_image(options.earlier), inputs.read_image(options.later)
    camera = inputs.camera_of(options, later.shape[1], later.shape[0])
    rotation = inputs.rotation_of(options, camera)
    if options.translation is not None and rotation is None:
        raise InputError("--translation: needs --rotation too: it is given in the earlier camera's axes")
    translation_m = None if options.translation is None else np.array(options.translation, np.float64)
    least_px = 16  # of a camera's side: else none can be assumed either
    if camera is None and min(later.shape) < least_px:
        raise InputError(
            f"{options.later}: found {later.shape[1]} x {later.shape[0]} px, needed are {least_px} x {least_px} and more"
        )
    source = "field_of_view" if options.hfov is not None else "calibration"
    pair = ParallaxPair(earlier, later, camera, source, rotation, translation_m)
    known = _known(options, later)
    _make(options.output)
    result, seconds = examine(pair, params, loops=options.loops)
    report = ParallaxReport(
        earlier=options.earlier.name,
        later=options.later.name,
        size_px=(later.shape[1], later.shape[0]),
        result=result,
        baseline_m=None if translation_m is None else float(np.linalg.norm(translation_m)),
        interval_s=options.interval,
        seconds=seconds,
        loops=options.loops,
        pictures=_write_pictures(options.output, figures(later, result)),
        side_by_side=side_by_side(
            PairInput(earlier, later, camera, rotation, translation_m), params, known, options.loops
        ),
    )
    return _write_report(options.output, as_json(report), as_markdown(report))


def _known(options: argparse.Namespace, later: NDArray[np.uint8]) -> KnownPair | None:
    from detector.commands.side_by_side_table import known_pair

    if options.no_truth:
        return None
    return known_pair(options.earlier, options.later, (later.shape[1], later.shape[0]))


def _write_pictures(folder: Path, drawn: dict[str, NDArray[np.uint8]]) -> dict[str, str]:
    """Write the figures and remove those of an earlier run, which would show another pair; return their files by name."""
    for name in (*_PAPER_FIGURES, *_PARALLAX_FIGURES):
        file = folder / f"{name}.png"
        if name in drawn:
            inputs.write_picture("-o", file, drawn[name])
        else:
            _remove(file)
    return {name: f"{name}.png" for name in (*_PAPER_FIGURES, *_PARALLAX_FIGURES) if name in drawn}


def _write_report(folder: Path, content: dict[str, Any], text: str) -> int:
    _write(folder / "report.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    _write(folder / "report.md", text)
    print(folder / "report.md")
    return 0


def _coordinate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _MOST_M:
        raise argparse.ArgumentTypeError(
            f"found {text!r}, allowed are metres from -{_MOST_M:g} to {_MOST_M:g}"
        )
    return value


def _loops(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() and len(text) < 6 else 0
    if not 1 <= value <= _MAX_LOOPS:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are 1 to {_MAX_LOOPS}")
    return value


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"-o {folder}: the folder cannot be made: {inputs.cause(error)}") from error


def _remove(file: Path) -> None:
    try:
        file.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"-o {file}: cannot be removed: {inputs.cause(error)}") from error


def _write(file: Path, text: str) -> None:
    try:
        file.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"-o {file}: cannot be written: {inputs.cause(error)}") from error
