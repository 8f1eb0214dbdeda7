"""Arguments of a command line that flies: what a single flight and a suite have in common."""

from __future__ import annotations

import argparse
import re
from typing import get_args

from companion.sim.estimate_errors import EstimateErrors
from companion.sim.flight import FlightError, FlightSpec, Method, PlannerKind


def add_flight_arguments(parser: argparse.ArgumentParser) -> None:
    """Add everything that decides a flight, except world, seed and method."""
    default = FlightSpec()
    parser.add_argument(
        "--difficulty", default=default.difficulty, help="of a random world (default: %(default)s)"
    )
    parser.add_argument("--planner", choices=get_args(PlannerKind), default=default.planner)
    parser.add_argument("--realtime", action="store_true", help="fly in real time instead of simulated time")
    parser.add_argument(
        "--size",
        type=image_size,
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


def flight_spec(arguments: argparse.Namespace, *, world: str, seed: int, method: Method) -> FlightSpec:
    """Return the specification that those arguments ask for.

    Raises
    ------
    companion.sim.flight.FlightError
        When a value is not allowed.
    """
    try:
        estimate = EstimateErrors(arguments.drift, arguments.position_noise, arguments.heading_noise)
    except ValueError as error:
        raise FlightError(str(error)) from error
    width_px, height_px = arguments.size
    names = ("difficulty", "planner", "realtime", "hfov_deg", "frame_rate_hz", "detection_s", "time_limit_s")
    return FlightSpec(
        world=world,
        seed=seed,
        method=method,
        **{name: getattr(arguments, name) for name in names},
        width_px=width_px,
        height_px=height_px,
        estimate=estimate,
    )


def image_size(text: str) -> tuple[int, int]:
    """Return width and height of text such as ``320x240``; for argparse."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 320x240, got {text!r}")
    return int(found[1]), int(found[2])
