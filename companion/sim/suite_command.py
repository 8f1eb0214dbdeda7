"""The command line of ``companion sim suite``."""

from __future__ import annotations

import argparse
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import cast, get_args

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from companion.sim.flight import Method
from companion.sim.flight_arguments import add_flight_arguments, flight_spec
from companion.sim.suite import (
    Finished,
    FlyAll,
    PlannedFlight,
    SuiteError,
    finished_flights,
    plan_flights,
    run_suite,
)
from companion.sim.suite_process import FlightProcesses
from companion.sim.suite_report import OUTCOME_HEADS, OUTCOMES, report_json, rows_of, write_report
from companion.sim.suite_runners import fly_locally, fly_on_cluster
from companion.sim.suite_sheet import write_sheet
from companion.sim.suite_worlds import world_of

_DESCRIPTION = """\
Fly every world with every seed and every method. Each flight has a file in the folder; a suite that was interrupted
goes on where it was when the same command is given again. The folder gets suite.md and suite.json with all figures,
sheet.png with every flight from above, and a video of every flight that did not succeed."""
_INTERRUPTED = 130
"""As shells have it for Ctrl-C."""


def add_suite_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``suite`` to the sub-commands of ``companion sim``."""
    parser = commands.add_parser(
        "suite", help="many flights, and a report", description=_DESCRIPTION, allow_abbrev=False
    )
    parser.add_argument(
        "--worlds",
        nargs="+",
        required=True,
        metavar="NAME|FILE.toml|random",
        help="which worlds, separated by spaces or commas",
    )
    parser.add_argument(
        "--seeds", type=_seeds, default=(0,), metavar="A..B", help="from A to B; or a single one (default: 0)"
    )
    parser.add_argument(
        "--methods",
        type=_methods,
        default=("parallax",),
        metavar="M,M",
        help=f"of {', '.join(get_args(Method))} (default: parallax)",
    )
    add_flight_arguments(parser)
    parser.add_argument(
        "-j",
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="flights at a time on this machine (default: 1)",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="fly on a Dask cluster instead, such as tcp://10.0.0.5:8786"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="the suite's folder")
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.set_defaults(command=_fly_suite, parser=parser)


def _fly_suite(arguments: argparse.Namespace) -> int:
    folder: Path = arguments.output
    worlds = [name for words in arguments.worlds for name in words.split(",") if name]
    if not worlds:
        arguments.parser.error("--worlds: no world is named")
    template = flight_spec(arguments, world=worlds[0], seed=0, method=arguments.methods[0])
    flights = plan_flights(worlds, arguments.seeds, arguments.methods, template)
    # A fault of a world is one line now, not a hundred failed simulations later.
    for flight in {flight.spec.world: flight for flight in reversed(flights)}.values():
        world_of(flight)
    try:
        with _ended_like_ctrl_c():
            finished = _fly_with_progress(flights, folder, _runner(arguments))
    except KeyboardInterrupt:
        done = len(finished_flights(flights, folder))
        Console(stderr=True).print(
            f"interrupted: {done} of {len(flights)} flights are flown; the same command flies the others"
        )
        return _INTERRUPTED
    write_report(finished, folder)
    write_sheet(finished, folder / "sheet.png", world_of)
    if arguments.json:
        sys.stdout.write(report_json(finished, folder) + "\n")
    else:
        _print(finished, folder)
    return 1 if any(flight.result is None for flight in finished) else 0


def _runner(arguments: argparse.Namespace) -> FlyAll:
    if arguments.jobs < 1:
        raise SuiteError(f"--jobs: found {arguments.jobs}; allowed: 1 or more")
    if arguments.scheduler is not None:
        return partial(fly_on_cluster, scheduler=arguments.scheduler)
    return partial(fly_locally, jobs=arguments.jobs, processes=FlightProcesses())


def _fly_with_progress(
    flights: tuple[PlannedFlight, ...], folder: Path, fly_all: FlyAll
) -> tuple[Finished, ...]:
    counts: dict[str, int] = {}
    with Progress(
        TextColumn("flights"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=Console(stderr=True),
    ) as progress:
        task = progress.add_task("", total=len(flights), completed=len(finished_flights(flights, folder)))

        def on_finished(finished: Finished) -> None:
            counts[finished.outcome] = counts.get(finished.outcome, 0) + 1
            shown = ", ".join(f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if outcome in counts)
            progress.update(task, advance=1, description=shown)
            if finished.error is not None:
                progress.console.print(f"{finished.flight.name}: {finished.error}", markup=False)

        return run_suite(flights, folder, fly_all, on_finished)


@contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """Let a polite request to end (SIGTERM, as ``timeout`` and service managers send) do what Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print(finished: tuple[Finished, ...], folder: Path) -> None:
    console = Console()
    console.print(
        f"{len(finished)} flights; more in {folder}:", soft_wrap=True, markup=False, highlight=False
    )
    # Narrow, so that a terminal of 80 columns has room for it.
    table = Table(box=None, pad_edge=False, collapse_padding=True)
    for head in ("world", "method", "flights", *OUTCOME_HEADS, "succeeded"):
        table.add_column(head, justify="left" if head in ("world", "method") else "right")
    for row in rows_of(finished):
        cells = (row.world, row.method, row.flights, *row.outcomes, row.succeeded)
        table.add_row(*(str(cell) for cell in cells))
    console.print(table)


def _seeds(text: str) -> tuple[int, ...]:
    found = re.fullmatch(r"(\d{1,9})(?:\.\.(\d{1,9}))?", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"expected A..B such as 1..50, or one number, got {text!r}")
    first, last = int(found[1]), int(found[2] or found[1])
    if last < first:
        raise argparse.ArgumentTypeError(f"expected A..B with A up to B, got {text!r}")
    return tuple(range(first, last + 1))


def _methods(text: str) -> tuple[Method, ...]:
    methods = tuple(text.split(","))
    allowed = get_args(Method)
    if unknown := [method for method in methods if method not in allowed]:
        raise argparse.ArgumentTypeError(f"expected some of {','.join(allowed)}, got {unknown[0]!r}")
    return cast(tuple[Method, ...], methods)
