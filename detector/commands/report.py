"""``detector report A B -o DIR``: how the answer to one pair came about, in the figures and tables of the paper."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Final

from detector.commands import inputs
from detector.commands.inputs import InputError

_DESCRIPTION: Final = """\
Show how the answer to one pair of images came about: the paper's Figs. 3 to 6 as PNG, its Tables 1 and 2 as Markdown and JSON.
"""

_EPILOG: Final = f"""\
{inputs.ROTATION_HELP}
files written into DIR
  report.md    tables, figures and the answer, for people
  report.json  the same figures for programs; docs/report.md says what each key is
  figure-3.png flow before and after the filters, and what each filter dropped
  figure-4.png the length and angular filters, and what p, n and k were chosen by
  figure-5.png clusters by magnitude, and the LMCC
  figure-6.png lines, vanishing-point candidates and the direction
  A figure is left out where the answer came before its step; one of an earlier run is then removed.

exit code
  0  written, also where the answer is "none"
  2  the command line or a file that it names cannot be used; one line on stderr says which and why
"""

_FIGURES: Final = ("figure-3", "figure-4", "figure-5", "figure-6")
_MAX_LOOPS: Final = 1000


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
    inputs.add_params_arguments(parser)
    inputs.add_camera_arguments(parser)
    inputs.add_rotation_argument(parser)
    parser.add_argument(
        "--loops", type=_loops, default=5, metavar="N", help="loops timed of each kind (default: %(default)s)"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from detector.commands.report_document import Report, as_json, as_markdown
    from detector.drawing.figures import figures
    from detector.report import Pair, cost_of_loops, examine

    params = inputs.params_of(options)
    earlier, later = inputs.read_image(options.earlier), inputs.read_image(options.later)
    camera = inputs.camera_of(options, later.shape[1], later.shape[0])
    pair = Pair(earlier, later, camera, inputs.rotation_of(options, camera))
    folder: Path = options.output
    _make(folder)
    steps = examine(pair, params)
    first, other = cost_of_loops(pair, params, loops=options.loops)
    drawn = figures(pair, steps, params)
    for name in _FIGURES:
        file = folder / f"{name}.png"
        if name in drawn:
            inputs.write_picture("-o", file, drawn[name])
        else:
            _remove(file)  # it would show another pair
    report = Report(
        earlier=options.earlier.name,
        later=options.later.name,
        size_px=(later.shape[1], later.shape[0]),
        preset=options.preset,
        steps=steps,
        first=first,
        other=other,
        loops=options.loops,
        pictures={name: f"{name}.png" for name in _FIGURES if name in drawn},
    )
    _write(folder / "report.json", json.dumps(as_json(report), indent=1, allow_nan=False) + "\n")
    _write(folder / "report.md", as_markdown(report))
    print(folder / "report.md")
    return 0


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
