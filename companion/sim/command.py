"""The command line of ``companion sim``: one flight; its sub-commands fly many, or make pairs of frames."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.table import Table

from companion.sim.estimate_errors import EstimateErrors
from companion.sim.flight import FlightError, FlightResult, FlightSpec, Method, PlannerKind, run_flight

_DESCRIPTION = """\
Fly a simulated vehicle through an indoor world, closed loop: a planner that knows nothing of obstacles streams the
goal, a rendered camera feeds the real service, and the service's setpoints fly the vehicle. Simulated time by default:
the same command gives the same flight, bit for bit. The exit code is 0 whatever became of the flight."""


def sim_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion sim``; it sets ``command``, which takes the arguments and returns an exit code."""
    parser = argparse.ArgumentParser(prog="companion sim", description=_DESCRIPTION, allow_abbrev=False)
    _add_flight_arguments(parser)
    parser.set_defaults(command=_fly, parser=parser)
    return parser


def _add_flight_arguments(parser: argparse.ArgumentParser) -> None:
    default = FlightSpec()
    parser.add_argument("--world", metavar="NAME|FILE|random", help="built-in world, world file, or random")
    parser.add_argument("--seed", type=int, default=default.seed, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--difficulty", default=default.difficulty, help="of a random world (default: %(default)s)"
    )
    parser.add_argument(
        "--method",
        choices=get_args(Method),
        default=default.method,
        help="paper: the service with its default preset; off: no service, the planner speaks to the autopilot",
    )
    parser.add_argument("--planner", choices=get_args(PlannerKind), default=default.planner)
    parser.add_argument("--realtime", action="store_true", help="fly in real time instead of simulated time")
    parser.add_argument(
        "--size",
        type=_size,
        default=(default.width_px, default.height_px),
        metavar="WxH",
        help="of the camera's image in pixels (default: 320x240)",
    )
    for option, name, metavar, text in (
        ("--hfov", "hfov_deg", "DEG", "of the camera"),
        ("--rate", "frame_rate_hz", "HZ", "frames, and so decisions, a second"),
        ("--detection", "detection_s", "S", "simulated time that the detector takes for a frame"),
        ("--time-limit", "time_limit_s", "S", "after which a flight is a timeout"),
    ):
        shown = getattr(default, name)
        note = "default: the world's" if shown is None else f"default: {shown:g}"
        parser.add_argument(
            option, dest=name, type=float, default=shown, metavar=metavar, help=f"{text} ({note})"
        )
    for option, metavar, text in (
        ("--drift", "M", "random walk of the autopilot's estimate, m after one second"),
        ("--position-noise", "M", "its wavering, m"),
        ("--heading-noise", "DEG", "its heading's"),
    ):
        parser.add_argument(option, type=float, default=0.0, metavar=metavar, help=f"{text} (default: none)")
    parser.add_argument("--record", type=Path, metavar="OUT.npz", help="write everything that was recorded")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _fly(arguments: argparse.Namespace) -> int:
    if arguments.world is None:
        arguments.parser.error("--world is needed: the name of a built-in world, a world file, or random")
    try:
        estimate = EstimateErrors(arguments.drift, arguments.position_noise, arguments.heading_noise)
    except ValueError as error:
        raise FlightError(str(error)) from error
    width_px, height_px = arguments.size
    names = ("world", "difficulty", "seed", "method", "planner", "realtime", "hfov_deg", "frame_rate_hz")
    spec = FlightSpec(
        **{name: getattr(arguments, name) for name in (*names, "detection_s", "time_limit_s")},
        width_px=width_px,
        height_px=height_px,
        estimate=estimate,
    )
    result = run_flight(spec, record=arguments.record)
    if arguments.json:
        sys.stdout.write(json.dumps(result.as_dict()) + "\n")
    else:
        _print(result)
    return 0


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 320x240, got {text!r}")
    return int(found[1]), int(found[2])


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
