"""``companion status``: what the running service says of itself."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from companion.config_sources import ConfigPlaces, load
from companion.status.client import NoAnswerError, NotRunningError, StatusClient
from companion.status.server import STATUS
from companion.status.show import status_text
from companion.status.unix_socket import NAME, USUAL_FOLDER, runtime_folder, socket_path

_WATCH_S: Final = 1.0


def status_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion status``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(
        prog="companion status",
        description="Prints what the running service says of itself: state and reason, rates and ages, links, worker, "
        "computer. Exit code 1: it is not running, or does not answer.",
    )
    parser.add_argument("--watch", action="store_true", help="again every second, until Ctrl-C")
    parser.add_argument("--json", action="store_true", help="one JSON object, with --watch one a line")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("-s", "--socket", metavar="PATH", help="the service's socket")
    where.add_argument(
        "-c",
        "--config",
        metavar="FILE.toml",
        help="the service's configuration, for status.socket; without both "
        f"{USUAL_FOLDER / NAME}, where the unit of systemd puts it",
    )
    parser.set_defaults(command=_run)
    return parser


def chosen_socket(socket: str | None, config: str | None) -> Path:
    """Return the socket that a command line means: named, configured, or where the unit puts it.

    Raises
    ------
    companion.errors.ConfigError
        When the configuration cannot be read.
    """
    if socket:
        return Path(socket)
    status = load(ConfigPlaces(Path(config) if config else None, dict(os.environ))).config.status
    return socket_path(status, runtime_folder(os.environ)) or USUAL_FOLDER / NAME


def _run(arguments: argparse.Namespace) -> int:
    path = chosen_socket(arguments.socket, arguments.config)
    if arguments.watch:
        _watch(path, as_json=arguments.json)
        return 0
    try:
        with StatusClient(path) as client:
            status = client.ask(STATUS)
    except NotRunningError as error:
        if not arguments.json:
            raise
        sys.stdout.write(json.dumps(_not_running(error), ensure_ascii=False) + "\n")
        return 1
    if arguments.json:
        sys.stdout.write(json.dumps({"running": True, **status}, ensure_ascii=False, indent=2) + "\n")
    else:
        sys.stdout.write(status_text(status))
    return 0


def _not_running(error: NotRunningError | NoAnswerError) -> dict[str, Any]:
    return {"running": False, "error": str(error)}


def _watch(path: Path, *, as_json: bool) -> None:
    """Show the status again and again; a service that ends is waited for."""
    if as_json:
        _follow(path, lambda status: _print_line(json.dumps(status, ensure_ascii=False)))
    elif not sys.stdout.isatty():
        _follow(path, lambda status: _print_line(_shown(status)))
    else:
        from rich.live import Live
        from rich.text import Text

        with Live(auto_refresh=False, screen=False) as live:
            _follow(path, lambda status: live.update(Text(_shown(status)), refresh=True))


def _shown(status: dict[str, Any]) -> str:
    return status_text(status) if status["running"] else f"{status['error']}\n"


def _print_line(text: str) -> None:
    """Print at once; end where nobody reads any more."""
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # What is left in the buffer would fail again, and be said, when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None


def _follow(path: Path, show: Callable[[dict[str, Any]], None]) -> None:
    while True:
        try:
            with StatusClient(path) as client:
                while True:
                    show({"running": True, **client.ask(STATUS)})
                    time.sleep(_WATCH_S)
        except (NotRunningError, NoAnswerError) as error:
            show(_not_running(error))
        time.sleep(_WATCH_S)
