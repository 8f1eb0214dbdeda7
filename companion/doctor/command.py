"""``companion doctor``: the command line."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from pathlib import Path

from companion.clock import RealClock
from companion.config_sources import ConfigPlaces, load
from companion.doctor.checks import judge
from companion.doctor.listen import examine
from companion.doctor.report import as_json, as_text, exit_code
from companion.log import open_log


def doctor_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion doctor``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(
        prog="companion doctor",
        description="Connects to autopilot, planner and camera as the service does, listens, and says what is missing "
        "and what to do about it. For the ground: stop the service first. Exit code 0: nothing failed.",
    )
    parser.add_argument(
        "-c", "--config", metavar="FILE.toml", help="configuration; without it the defaults hold"
    )
    parser.add_argument(
        "-s", "--seconds", type=_seconds, default=10.0, metavar="S", help="how long to listen (default: 10)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    file = Path(arguments.config) if arguments.config else None
    config = load(ConfigPlaces(file, dict(os.environ))).config
    # What happens meanwhile is in the checklist; only what is broken is worth a line of its own.
    quiet = config.log.model_copy(update={"level": "error"})
    with open_log(quiet) as log:
        findings = asyncio.run(examine(config, seconds=arguments.seconds, clock=RealClock(), log=log))
    checks = judge(findings, config)
    sys.stdout.write(as_json(checks) if arguments.json else as_text(checks))
    return exit_code(checks)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 2.0 <= seconds <= 600.0:
        raise argparse.ArgumentTypeError(f"{text}: expected 2 to 600 seconds")
    return seconds
