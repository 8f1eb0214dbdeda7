"""The command line of ``companion tune``."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from companion.tune.errors import TrialError, TuneError

if TYPE_CHECKING:
    from optuna.study import Study

    from companion.tune.cases import Cases
    from companion.tune.outcome import Outcome
    from companion.tune.space import Dimension

_DESCRIPTION: Final = """\
Search settings that answer better: of the detector against folders of pairs whose truth is known, or of the whole service in simulated
flights. A part of the cases is held out and says afterwards whether the gain is real.
"""
_EPILOG: Final = """\
examples
  companion tune PAIRS --trials 100 -o out                    the void map's settings, on a folder with a groundtruth.json
  companion tune WALK --truth LABELLED --min-baseline 0.25    pairs formed from poses
  companion tune --world door random --seeds 1..6 -o out   in simulated flights (extra sim)
  companion tune PAIRS --search round_trip_px=0.2..2 --search flow_sigma_px
  companion tune PAIRS --storage sqlite:///tune.db            the same command again, at the same time or later, goes on with the search

The folder gets companion.toml (for companion run -c) and params.toml, report.md, report.json and pictures. More: docs/tune.md

exit code
  0    done
  1    the search cannot be made; one line on stderr says why
  130  interrupted; what was finished is kept
"""
_INTERRUPTED: Final = 130


def tune_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion tune``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(
        prog="companion tune",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "folders", type=Path, nargs="*", metavar="DIR", help="pairs with truth (docs/evaluation.md)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out"), metavar="DIR", help="(default: out)"
    )
    parser.add_argument(
        "--trials",
        type=_count,
        default=100,
        metavar="N",
        help="finished trials that the search is to have, those of other processes and earlier runs included (default: %(default)s)",
    )
    parser.add_argument(
        "--storage",
        metavar="URL|FILE",
        help="where trials are kept: a database such as sqlite:///tune.db or postgresql://..., or a journal file, which may lie on a "
        "shared disk (default: study.journal in the folder of -o)",
    )
    parser.add_argument(
        "--study",
        default="void-companion",
        metavar="NAME",
        help="of the search in there (default: %(default)s)",
    )
    parser.add_argument("--method", choices=("parallax", "paper"), default="parallax")
    parser.add_argument(
        "--preset", choices=("default", "paper"), default="default", help="of the method paper"
    )
    parser.add_argument(
        "--search",
        action="append",
        default=[],
        metavar="NAME[=LOW..HIGH|=A,B]",
        help="a setting to search, in place of the usual ones; may be repeated. In flights also guidance.KEY and detector.KEY",
    )
    parser.add_argument(
        "--spread",
        type=_spread,
        default=4.0,
        metavar="F",
        help="range of a setting without its own: usual / F to usual * F, within what is allowed (default: 4)",
    )
    parser.add_argument(
        "--hold-out",
        type=_share,
        default=0.3,
        metavar="SHARE",
        help="of the pairs (the last of each folder) or seeds (the last) that the search does not see (default: 0.3)",
    )
    parser.add_argument(
        "--seed",
        type=_count,
        metavar="N",
        help="makes a search by one process repeatable (default: another each time)",
    )
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    pairs = parser.add_argument_group("pairs")
    pairs.add_argument(
        "--min-baseline", type=_metres, metavar="M", help="form pairs from the poses, at least this far apart"
    )
    pairs.add_argument(
        "--truth", type=Path, metavar="DIR", help="also use what this set knows of frames of the same names"
    )
    pairs.add_argument("--limit", type=_count, metavar="N", help="most pairs of a folder, evenly chosen")
    pairs.add_argument(
        "--poses",
        choices=("full", "rotation", "none"),
        default="full",
        help="what the method is told of the motion (default: full)",
    )
    flights = parser.add_argument_group("simulated flights")
    flights.add_argument(
        "--world", nargs="+", default=[], metavar="NAME|FILE.toml|random", help="fly here, in place of pairs"
    )
    flights.add_argument("--difficulty", default="medium", help="of a random world (default: %(default)s)")
    flights.add_argument(
        "--seeds", type=_seeds, default=(1, 2, 3), metavar="A..B", help="of the flights (default: 1..3)"
    )
    flights.add_argument(
        "--time-limit",
        type=_metres,
        metavar="S",
        help="after which a flight is a timeout (default: the world's)",
    )
    flights.add_argument(
        "-j", "--jobs", type=_count, default=1, metavar="N", help="flights at a time (default: 1)"
    )
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if bool(arguments.folders) == bool(arguments.world):
        raise TuneError("needed are folders of pairs, or --world for simulated flights (one of the two)")
    try:
        import optuna  # noqa: F401 - whether the extra is there
    except ModuleNotFoundError as error:
        raise TuneError("the search needs the extra tune: pip install 'void-companion[tune]'") from error
    from companion.tune import files, study
    from companion.tune.space import USUAL, USUAL_IN_FLIGHT, dimensions, usual_params

    in_flight = bool(arguments.world)
    names = arguments.search or (USUAL_IN_FLIGHT if in_flight else USUAL[arguments.method])
    space = dimensions(
        names,
        usual_params(arguments.method, arguments.preset),
        spread=arguments.spread,
        with_tables=in_flight,
    )
    cases = _flights(arguments) if in_flight else _pairs(arguments)
    files.make_folder(arguments.output)
    storage = study.open_storage(arguments.storage or study.default_storage(arguments.output))
    begun = study.open_study(storage, arguments.study, space, cases.about(), arguments.seed)
    with _ended_like_ctrl_c():
        try:
            _search(begun, space, cases, arguments.trials)
            outcome = _judged(begun, space, cases)
        except KeyboardInterrupt:
            done = len(study.finished(begun))
            sys.stderr.write(
                f"interrupted: {done} finished trials are kept; the same command goes on, and with --trials {max(done, 1)} "
                "it reports on these\n"
            )
            return _INTERRUPTED
    _report(arguments, begun, space, cases, outcome)
    return 0


# ---------------------------------------------------------------------- cases


def _pairs(arguments: argparse.Namespace) -> Cases:
    from companion.tune.pairs import TruePairs, load_pairs

    sets = [
        load_pairs(
            folder,
            min_baseline_m=arguments.min_baseline,
            truth=arguments.truth,
            limit=arguments.limit,
            hold_out=arguments.hold_out,
        )
        for folder in arguments.folders
    ]
    return TruePairs(sets, method=arguments.method, preset=arguments.preset, poses=arguments.poses)


def _flights(arguments: argparse.Namespace) -> Cases:
    from companion.sim.flight import FlightSpec
    from companion.sim.suite_process import FlightProcesses
    from companion.sim.suite_runners import fly_locally
    from companion.tune.flights import Flights

    template = FlightSpec(
        world=arguments.world[0],
        difficulty=arguments.difficulty,
        method=arguments.method,
        time_limit_s=arguments.time_limit,
        settings={"detector": {"preset": arguments.preset}} if arguments.method == "paper" else {},
    )
    return Flights(
        arguments.world,
        arguments.seeds,
        template,
        hold_out=arguments.hold_out,
        # Processes that were stopped once fly no more.
        fly_all=lambda: partial(fly_locally, jobs=arguments.jobs, processes=FlightProcesses()),
    )


# ---------------------------------------------------------------------- searching


def _search(begun: Study, space: tuple[Dimension, ...], cases: Cases, trials: int) -> None:
    from companion.tune import study

    with _progress("searching", trials, len(study.finished(begun))) as (moved, said):

        def on_trial(trial: Any) -> None:
            best = max((each.value or 0.0 for each in study.finished(begun)), default=math.nan)
            reason = trial.user_attrs.get("reason")
            said(f"best {best:.3f}" if reason is None else f"trial {trial.number}: {reason}")
            moved(len(study.finished(begun)))

        study.search(begun, space, cases, trials, on_trial=on_trial)


def _judged(begun: Study, space: tuple[Dimension, ...], cases: Cases) -> Outcome:
    from companion.tune import outcome, study

    best, usual = begun.best_trial, {each.name: each.usual for each in space}
    trials = study.finished(begun)
    with_usual = next((trial for trial in trials if study.settings_of(trial, space) == usual), None)
    try:
        before = cases.scores(usual, "searched") if with_usual is None else study.scores_of(with_usual)
        return outcome.judged(
            cases,
            study.settings_of(best, space),
            usual,
            searched=outcome.gain_of(before, study.scores_of(best)),
            trials=len(trials),
            best_trial=best.number,
            importances=study.importances(begun),
        )
    except TrialError as error:
        raise TuneError(f"the usual or the best settings cannot be judged: {error}") from error


def _report(
    arguments: argparse.Namespace,
    begun: Study,
    space: tuple[Dimension, ...],
    cases: Cases,
    found: Outcome,
) -> None:
    from companion.tune import files, outcome, pictures, study

    trials = study.finished(begun)
    drawn = {"history.png": pictures.history(trials), "settings.png": pictures.settings(trials, space)}
    if found.importances:
        drawn["importance.png"] = pictures.importance(found.importances)
    text = outcome.markdown(found, tuple(drawn))
    report: Mapping[str, Any] = {
        **found.as_dict(),
        "warning": outcome.warning_of(found),
        "method": arguments.method,
        "space": [each.as_dict() for each in space],
        "cases": cases.about(),
        "trial_values": [
            {"number": trial.number, "value": trial.value, "settings": dict(study.settings_of(trial, space))}
            for trial in trials
        ],
    }
    texts = {**files.config_files(found, arguments.method, arguments.preset), "report.md": text}
    files.write(arguments.output, texts, drawn, report)
    if (warning := outcome.warning_of(found)) is not None:
        sys.stderr.write(f"warning: {warning}\n")
    names = ", ".join((*texts, "report.json", *drawn))
    shown = (
        json.dumps(report, allow_nan=False) if arguments.json else f"{text}\nIn {arguments.output}: {names}"
    )
    sys.stdout.write(f"{shown}\n")


@contextlib.contextmanager
def _progress(
    what: str, total: int, done: int
) -> Iterator[tuple[Callable[[int], None], Callable[[str], None]]]:
    """Show how far it is, on a terminal; else a line now and then would be noise."""
    if not sys.stderr.isatty():
        yield lambda _: None, lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=total, completed=done)
        yield (
            lambda count: bar.update(task, completed=count),
            lambda words: bar.update(task, description=words),
        )


@contextlib.contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM do what Ctrl-C does, and let both work where the shell has us ignore SIGINT (a background job)."""
    before = {
        number: signal.signal(number, signal.default_int_handler)
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ---------------------------------------------------------------------- arguments


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 1_000_000):
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are whole numbers from 1 to 1000000")
    return int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _share(text: str) -> float:
    if not 0.0 <= (value := _number(text)) <= 0.9:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed is a share from 0 to 0.9")
    return value


def _spread(text: str) -> float:
    if not 1.0 < (value := _number(text)) <= 1000.0:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed is more than 1 and up to 1000")
    return value


def _metres(text: str) -> float:
    if not 0.0 < (value := _number(text)) <= 1000.0:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed is more than 0 and up to 1000")
    return value


def _seeds(text: str) -> tuple[int, ...]:
    found = re.fullmatch(r"(\d{1,9})(?:\.\.(\d{1,9}))?", text)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if last < first:
        raise argparse.ArgumentTypeError(
            f"found {text!r}, needed is A..B such as 1..6, A up to B, or one number"
        )
    return tuple(range(first, last + 1))
