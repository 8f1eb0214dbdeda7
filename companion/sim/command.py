"""The command line of ``companion sim``: one flight; its sub-commands fly many, or make pairs of frames."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.table import Table

from companion.sim.flight import FlightResult, FlightSpec, Method, fly_and_judge
from companion.sim.flight_arguments import add_flight_arguments, flight_spec
from companion.sim.flight_loop import camera_model_of
from companion.sim.flight_video import write_flight_video
from companion.sim.flight_worlds import find_world, place_in
from companion.sim.pairs import add_pairs_parser
from companion.sim.suite_command import add_suite_parser

_DESCRIPTION = """\
Fly a simulated vehicle through an indoor world, closed loop: a planner that knows nothing of obstacles streams the
goal, a rendered camera feeds the real service, and the service's setpoints fly the vehicle. Simulated time by default:
the same command gives the same flight, bit for bit. The exit code is 0 whatever became of the flight."""


def sim_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion sim``; it sets ``command``, which takes the arguments and returns an exit code."""
    parser = argparse.ArgumentParser(prog="companion sim", description=_DESCRIPTION, allow_abbrev=False)
    _add_arguments(parser)
    parser.set_defaults(command=_fly, parser=parser)
    commands = parser.add_subparsers(title="more", metavar="suite | pairs")
    add_suite_parser(commands)
    add_pairs_parser(commands)
    return parser


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    default = FlightSpec()
    parser.add_argument("--world", metavar="NAME|FILE|random", help="built-in world, world file, or random")
    parser.add_argument("--seed", type=int, default=default.seed, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--method",
        choices=get_args(Method),
        default=default.method,
        help="parallax: the service with the void map; paper: with the published method; straight, flow_balance, line_vp: rivals for scale in its place (simulated time only); off: no service, the planner speaks to the autopilot",
    )
    add_flight_arguments(parser)
    parser.add_argument("--video", type=Path, metavar="OUT.mp4", help="write an annotated video")
    parser.add_argument("--record", type=Path, metavar="OUT.npz", help="write everything that was recorded")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _fly(arguments: argparse.Namespace) -> int:
    if arguments.world is None:
        arguments.parser.error("--world is needed: the name of a built-in world, a world file, or random")
    spec = flight_spec(arguments, world=arguments.world, seed=arguments.seed, method=arguments.method)
    world = find_world(spec.world, seed=spec.seed, difficulty=spec.difficulty)
    result, record = fly_and_judge(spec, place_in(world))
    if arguments.record is not None:
        record.save(arguments.record)
    if arguments.video is not None:
        write_flight_video(record, world, camera_model_of(spec), arguments.video)
    if arguments.json:
        sys.stdout.write(json.dumps(result.as_dict()) + "\n")
    else:
        _print(result)
    return 0


def _print(result: FlightResult) -> None:
    table = Table(
        title=f"{result.world}, seed {result.seed}, {result.method}: {result.outcome}",
        title_justify="left",
        show_header=False,
    )
    for name, value in result.as_dict().items():
        if name not in ("world", "seed", "method", "outcome"):
            table.add_row(name, _words(value))
    Console().print(table)


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items()) or "-"
    return "-" if value is None else str(value)
