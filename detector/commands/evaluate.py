"""``detector evaluate DIR...``: how right the detector is on images with known truth."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.commands.inputs import InputError

if TYPE_CHECKING:
    from detector.evaluation.dataset import ImageSet, Pair
    from detector.evaluation.run import Evaluation, Settings
    from detector.params import DetectorParams

_DESCRIPTION: Final = """\
Judge the detector on folders of images against all that is known about them: directions, single planes, focus of expansion,
vanishing points, time to contact.
"""

_EPILOG: Final = """\
a folder holds one of
  groundtruth.json              frames, pairs and truth
  poses.json                    the frames of a walk with their poses; needs --min-baseline
  ROW_COL_FRONT_LEFT.png ...    images on a grid of robot positions (NavigationNet's naming); see --grid-front

--compare
  KEY=VALUE runs everything a second time with that change and prints the differences with 95 % intervals of a paired bootstrap.
  KEY is method, preset, poses (full, rotation, none) or a parameter of the detector; several changes make one second run.
  FILE.json compares with what --json or -o wrote before, on the same pairs.

Layout of the files, rules of judgement and JSON keys: docs/evaluation.md.

exit code
  0  done
  2  the command line or a file that it names cannot be used; one line on stderr says which and why
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of ``detector``."""
    parser = commands.add_parser(
        "evaluate",
        help="judge on images with known truth",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="set of images, see below")
    parser.add_argument(
        "--method",
        default="paper",
        metavar="NAME",
        help="paper, parallax, straight, flow_balance or line_vp (default: %(default)s)",
    )
    inputs.add_params_arguments(parser)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="changes",
        metavar="KEY=VALUE",
        help="replace one parameter; may be repeated",
    )
    parser.add_argument(
        "--derotated", action="store_true", help="use b_derot, the later image turned back, in place of b"
    )
    parser.add_argument(
        "--min-valid-frac",
        type=_share,
        metavar="F",
        help="leave out pairs whose later depth image is known in less than this share",
    )
    parser.add_argument(
        "--min-baseline",
        type=inputs.metres,
        metavar="M",
        help="form pairs from the poses: each frame and the latest earlier one at least this far away",
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="DIR",
        help="also use what this set knows about frames of the same file names",
    )
    told = parser.add_mutually_exclusive_group()
    told.add_argument(
        "--no-poses",
        action="store_const",
        const="none",
        dest="poses",
        help="do not tell the method the motion",
    )
    told.add_argument(
        "--rotation-only",
        action="store_const",
        const="rotation",
        dest="poses",
        help="tell it the rotation alone",
    )
    parser.add_argument(
        "--sequence",
        action="store_true",
        help="keep p, n and k within a folder; else every pair is a first loop",
    )
    parser.add_argument(
        "--grid-front",
        default="row+",
        metavar="WAY",
        help="where FRONT looks on a grid: row+, row-, col+ or col- (default: %(default)s)",
    )
    parser.add_argument(
        "--compare",
        action="append",
        default=[],
        metavar="KEY=VALUE|FILE.json",
        help="also run with a change, or read an earlier run, and compare",
    )
    parser.add_argument("--json", action="store_true", help="print a JSON list, one object a folder")
    parser.add_argument(
        "-o",
        dest="output",
        type=Path,
        metavar="DIR",
        help="write evaluation.json, evaluation.md and pictures of the worst answers there",
    )
    parser.set_defaults(run=_run, poses="full")


def _run(options: argparse.Namespace) -> int:
    import cv2

    from detector.evaluation import comparison, run, table
    from detector.evaluation.dataset import DatasetError

    settings = _settings(options)
    changed, saved = _other(options, settings)
    try:
        sets = [_load(folder, options) for folder in options.folders]
    except DatasetError as error:
        raise InputError(inputs.one_line(error)) from error
    if options.output is not None:
        _make_folder(options.output)

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the seconds are those of one core
    runs = [settings] if changed is None else [settings, changed]
    steps = len(runs) * sum(run.count_steps(images, pairs) for images, pairs in sets)
    evaluations: list[list[Evaluation]] = [[] for _ in runs]
    try:
        with _progress(steps) as on_step:
            for images, pairs in sets:
                for each, done in zip(runs, evaluations, strict=True):
                    done.append(run.evaluate(images, pairs, each, inputs.read_image, on_step=on_step))
    except DatasetError as error:
        raise InputError(inputs.one_line(error)) from error
    finally:
        cv2.setNumThreads(threads)

    summaries = [run.summary(evaluation) for evaluation in evaluations[0]]
    text = table.evaluations(summaries)
    compared: dict[str, Any] | None = None
    if changed is not None or saved is not None:
        others = saved if saved is not None else [run.summary(evaluation) for evaluation in evaluations[1]]
        try:
            compared = comparison.compare(summaries, others)
        except comparison.ComparisonError as error:
            raise InputError(inputs.one_line(f"--compare: {error}")) from error
        second = " ".join(options.compare)
        for item, entry, other in zip(summaries, compared["sets"], others, strict=True):
            against = {key: value for key, value in other.items() if key not in ("per_pair", "per_frame")}
            item["comparison"] = {"with": second, **entry, "against": against}
        text += "\n\n" + table.comparison(compared, "this", second)
    cleaned = inputs.json_clean(summaries)
    if options.output is not None:
        _write(options.output, cleaned, inputs.json_clean(compared), text)
        _write_sheets(options.output, evaluations[0])
    print(json.dumps(cleaned, allow_nan=False) if options.json else text)
    return 0


# ---------------------------------------------------------------------- input


def _settings(options: argparse.Namespace) -> Settings:
    from detector.evaluation.methods import METHODS
    from detector.evaluation.run import Settings

    if options.method not in METHODS:
        raise InputError(f"--method: found {options.method!r}, allowed are {', '.join(METHODS)}")
    changes = dict(_assignment("--set", text) for text in options.changes)
    return Settings(
        method=options.method,
        preset=options.preset,
        params=_with_changes("--set", inputs.params_of(options), changes),
        poses=options.poses,
        derotated=options.derotated,
        sequence=options.sequence,
    )


def _with_changes(option: str, params: DetectorParams, changes: dict[str, Any]) -> DetectorParams:
    from detector.params import DetectorParams, ParamsError

    if not changes:
        return params
    try:
        # Every field is given, so that the preset it starts from makes no difference.
        return DetectorParams.preset("default", **{**params.model_dump(), **changes})
    except ParamsError as error:
        raise InputError(inputs.one_line(f"{option}: {error}".replace("preset default: ", ""))) from error


def _assignment(option: str, text: str) -> tuple[str, Any]:
    """Return KEY and VALUE, which is TOML; a bare word is a string."""
    key, equals, value = text.partition("=")
    if not equals:
        raise InputError(f"{option}: found {text!r}, needed is KEY=VALUE")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def _other(
    options: argparse.Namespace, settings: Settings
) -> tuple[Settings | None, list[dict[str, Any]] | None]:
    """Return what ``--compare`` asks for: changed settings, or a saved evaluation."""
    files = [Path(text) for text in options.compare if "=" not in text]
    if not options.compare:
        return None, None
    if not files:
        return _changed(options, settings), None
    if len(options.compare) > 1:
        raise InputError("--compare: a file goes alone, it cannot be joined with other changes")
    return None, _saved(files[0])


def _changed(options: argparse.Namespace, settings: Settings) -> Settings:
    from detector.evaluation.methods import METHODS
    from detector.evaluation.run import POSES

    changes = dict(_assignment("--compare", text) for text in options.compare)
    for key, allowed in (("method", tuple(METHODS)), ("poses", POSES)):
        if key in changes and changes[key] not in allowed:
            raise InputError(f"--compare: {key}: found {changes[key]!r}, allowed are {', '.join(allowed)}")
    own = {key: changes.pop(key) for key in ("method", "poses", "preset") if key in changes}
    params = settings.params
    if "preset" in own:
        again = argparse.Namespace(preset=own["preset"], params=options.params)
        try:
            params = inputs.params_of(again)
        except InputError as error:
            raise InputError(f"--compare: {error}") from error
        params = _with_changes("--set", params, dict(_assignment("--set", text) for text in options.changes))
    return dataclasses.replace(settings, params=_with_changes("--compare", params, changes), **own)


def _saved(path: Path) -> list[dict[str, Any]]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--compare {path}: cannot be read: {inputs.cause(error)}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"--compare {path}: is not valid JSON: {inputs.one_line(error)}") from error
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise InputError(f"--compare {path}: found no list of evaluations, as --json writes it")
    return found


def _load(folder: Path, options: argparse.Namespace) -> tuple[ImageSet, Sequence[Pair]]:
    """Return a set and the pairs of it that are asked for."""
    from detector.evaluation import dataset, run

    images = _images(folder, options)
    if options.truth is not None:
        images = dataset.with_truth_of(images, _images(options.truth, options))
    pairs = images.pairs
    if options.min_baseline is not None:
        pairs = dataset.pairs_by_baseline(images, options.min_baseline)
        if not pairs:
            raise InputError(
                f"{folder}: no two frames lie {options.min_baseline:g} m apart, or a little more"
            )
    elif not pairs and not run.count_steps(images, pairs):
        hint = "; --min-baseline M forms pairs from the poses" if images.has_poses else ""
        raise InputError(f"{folder}: holds no pairs and no frame with a vanishing point{hint}")
    if options.min_valid_frac is not None:
        before, pairs = len(pairs), run.enough_depth(images, pairs, options.min_valid_frac)
        if before and not pairs:
            raise InputError(
                f"{folder}: no later depth image is known in a share of {options.min_valid_frac:g}"
            )
    return images, pairs


def _images(folder: Path, options: argparse.Namespace) -> ImageSet:
    from detector.evaluation import dataset, grid_dataset

    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder")
    files = [folder / name for name in (dataset.TRUTH_FILE, dataset.POSES_FILE)]
    present = [path for path in files if path.is_file()]
    if present:
        return dataset.load_truth(present[0])
    if not grid_dataset.is_grid(folder):
        raise InputError(
            f"{folder}: holds neither {files[0].name} nor {files[1].name}, nor images named ROW_COL_FRONT_LEFT.png"
        )
    if options.grid_front not in grid_dataset.FACINGS:
        allowed = ", ".join(grid_dataset.FACINGS)
        raise InputError(f"--grid-front: found {options.grid_front!r}, allowed are {allowed}")
    return grid_dataset.load_grid(folder, options.grid_front)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed is a share from 0 to 1")
    return value


# ---------------------------------------------------------------------- output


@contextmanager
def _progress(steps: int) -> Iterator[Callable[[], None] | None]:
    """Show how far it is, on a terminal only."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("evaluating", total=steps)
        yield lambda: bar.advance(task)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"-o {folder}: cannot be made: {inputs.cause(error)}") from error


def _write(folder: Path, summaries: list[dict[str, Any]], compared: dict[str, Any] | None, text: str) -> None:
    files = {
        "evaluation.json": json.dumps(summaries, allow_nan=False, indent=1),
        "evaluation.md": text,
    }
    if compared is not None:
        files["comparison.json"] = json.dumps(compared, allow_nan=False, indent=1)
    for name, content in files.items():
        try:
            (folder / name).write_text(content + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(f"-o {folder / name}: cannot be written: {inputs.cause(error)}") from error


def _write_sheets(folder: Path, evaluations: Sequence[Evaluation]) -> None:
    from detector.evaluation.contact_sheet import contact_sheet

    for evaluation in evaluations:
        sheet = contact_sheet(evaluation, inputs.read_image)
        if sheet is not None:
            name = re.sub(r"[^\w.-]+", "_", evaluation.images.name)
            inputs.write_picture("-o", folder / f"worst-{name}.png", sheet)
