"""Command line of the companion service: ``companion run | config | check-config | demo | sim | cameras | calibrate``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from companion.errors import CompanionError, first_of
from detector.version import ShowVersion


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 done, 1 failed, 2 wrong usage."""
    _fill_standard_descriptors()
    words = list(sys.argv[1:] if argv is None else argv)
    own_parser = _OWN_PARSERS.get(words[0]) if words else None
    arguments = own_parser().parse_args(words[1:]) if own_parser else _parser().parse_args(words)
    try:
        code: int = arguments.command(arguments)
    except CompanionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def _fill_standard_descriptors() -> None:
    """Open what was closed of 0 to 2: a socket that got number 2 would be sent what libraries write to standard error."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="companion",
        description="Keeps an indoor drone flying toward open space: sits between planner and autopilot on MAVLink.",
    )
    parser.add_argument("--version", action=ShowVersion)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run the service until SIGINT or SIGTERM")
    run.add_argument(
        "-c", "--config", metavar="FILE.toml", help="configuration; without it the defaults hold"
    )
    run.add_argument(
        "-o",
        "--option",
        metavar="TABLE.KEY=VALUE",
        action="append",
        default=[],
        help="one value in place of what the files and the environment say; may be repeated",
    )
    run.set_defaults(command=_run)

    check = commands.add_parser("check-config", help="say whether a configuration file can be used")
    check.add_argument("file", metavar="FILE.toml")
    check.set_defaults(command=_check_config)

    demo = commands.add_parser(
        "demo",
        help="run it on embedded data: no camera, no drone",
        description="Real footage with a fake autopilot and planner through the real service, then a closed-loop "
        "room with a wall. Ends by itself within two minutes.",
    )
    demo.add_argument(
        "-o", "--output", metavar="DIR", default="out", help="folder for the annotated video (default: out)"
    )
    demo.add_argument("--json", action="store_true", help="print the summary as one JSON object")
    demo.set_defaults(command=_demo)

    # Their command lines are their own (``_OWN_PARSERS``); here they are for the list of commands.
    commands.add_parser("config", help="print a configuration: in force, default, its schema", add_help=False)
    commands.add_parser("sim", help="fly closed loop in a simulated indoor world", add_help=False)
    commands.add_parser("cameras", help="list cameras, take a picture, measure their timing", add_help=False)
    commands.add_parser("status", help="what the running service says of itself", add_help=False)
    commands.add_parser("record", help="begin or end a recording of the running service", add_help=False)
    commands.add_parser(
        "replay", help="a recording through the present code: what it decides otherwise", add_help=False
    )
    commands.add_parser("doctor", help="say what is missing before a flight, and what to do", add_help=False)
    commands.add_parser("calibrate", help="make or judge a camera file with a board", add_help=False)
    commands.add_parser(
        "tune", help="search settings against known truth or in simulated flights", add_help=False
    )
    commands.add_parser("web", help="the page with recordings: compare settings on them", add_help=False)
    return parser


def _config_parser() -> argparse.ArgumentParser:
    from companion.config_command import config_parser

    return config_parser()


def _sim_parser() -> argparse.ArgumentParser:
    from companion.sim.command import sim_parser  # much that nothing else needs

    return sim_parser()


def _cameras_parser() -> argparse.ArgumentParser:
    from companion.cameras import cameras_parser

    return cameras_parser()


def _doctor_parser() -> argparse.ArgumentParser:
    from companion.doctor.command import doctor_parser

    return doctor_parser()


def _status_parser() -> argparse.ArgumentParser:
    from companion.status.command import status_parser

    return status_parser()


def _record_parser() -> argparse.ArgumentParser:
    from companion.recorder.command import record_parser

    return record_parser()


def _replay_parser() -> argparse.ArgumentParser:
    from companion.replay.command import replay_parser

    return replay_parser()


def _calibrate_parser() -> argparse.ArgumentParser:
    from companion.calibrate.command import calibrate_parser

    return calibrate_parser()


def _tune_parser() -> argparse.ArgumentParser:
    from companion.tune.command import tune_parser

    return tune_parser()


def _web_parser() -> argparse.ArgumentParser:
    from companion.web.command import web_parser

    return web_parser()


_OWN_PARSERS: Final[Mapping[str, Callable[[], argparse.ArgumentParser]]] = {
    "config": _config_parser,
    "sim": _sim_parser,
    "cameras": _cameras_parser,
    "doctor": _doctor_parser,
    "calibrate": _calibrate_parser,
    "status": _status_parser,
    "record": _record_parser,
    "replay": _replay_parser,
    "tune": _tune_parser,
    "web": _web_parser,
}
"""Commands whose modules import much that nothing else needs."""


def _run(arguments: argparse.Namespace) -> int:
    import asyncio
    import gc

    from companion.clock import RealClock
    from companion.config_sources import ConfigPlaces, load
    from companion.event_loop import loop_factory
    from companion.io.taps import LogTap
    from companion.log import LevelGate, open_log
    from companion.service import Service
    from companion.status.unix_socket import runtime_folder
    from companion.systemd import ServiceNotifier

    notifier = ServiceNotifier.from_environment()  # before anything is started that could inherit it
    places = ConfigPlaces(
        Path(arguments.config) if arguments.config else None, dict(os.environ), tuple(arguments.option)
    )
    config = load(places).config
    gate = LevelGate(config.log.level)

    async def serve() -> None:
        service = Service(
            config,
            clock=RealClock(),
            log=log,
            notifier=notifier,
            places=places,
            gate=gate,
            runtime_folder=runtime_folder(os.environ),
            log_tap=tap,
        )
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, service.stop)
        loop.add_signal_handler(signal.SIGHUP, service.reload)
        await service.run()

    gc.freeze()  # what is loaded stays: a full collection that looks through it stops the forwarding, 40 ms on a slow computer
    tap = LogTap()
    with open_log(config.log, gate=gate, tap=tap) as log:
        try:
            with asyncio.Runner(loop_factory=loop_factory(config.link.event_loop)) as runner:
                runner.run(serve())
        except* CompanionError as group:
            failure = first_of(group)
            log.critical("service_failed", error=str(failure))
            return_code = 1
        else:
            return_code = 0
    return return_code


def _check_config(arguments: argparse.Namespace) -> int:
    import asyncio

    from companion.clock import RealClock
    from companion.config_sources import ConfigPlaces, load
    from companion.log import open_log
    from companion.vision.supervisor import VisionSupervisor

    config = load(ConfigPlaces(Path(arguments.file), dict(os.environ))).config
    with open_log(config.log) as log:
        # The camera file and the detector's parameters are the worker's to read: one is started for it.
        supervisor = VisionSupervisor(
            config.detector, config.camera, clock=RealClock(), on_report=lambda _: None, log=log
        )
        asyncio.run(supervisor.validate())
    print(f"{arguments.file}: good")
    return 0


def _demo(arguments: argparse.Namespace) -> int:
    from companion.sim.demo import run_demo

    return run_demo(Path(arguments.output), as_json=arguments.json)
