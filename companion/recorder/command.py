"""``companion record``: begin or end a recording of the running service, and see what there is."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from companion.config_sources import ConfigPlaces, load
from companion.errors import CompanionError
from companion.recorder.disk import MIB, recordings
from companion.recorder.sink import folder_of
from companion.status.client import StatusClient
from companion.status.command import chosen_socket
from companion.status.server import STATUS

_WAIT_S: Final = 5.0
_LOOK_S: Final = 0.1


def record_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion record``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(
        prog="companion record",
        description="Begins or ends a recording of the running service, says whether one is on, or lists what there is.",
    )
    parser.add_argument("what", choices=("start", "stop", "status", "list"))
    where = parser.add_mutually_exclusive_group()
    where.add_argument("-s", "--socket", metavar="PATH", help="the service's socket")
    where.add_argument(
        "-c", "--config", metavar="FILE.toml", help="the service's configuration, for its socket and folder"
    )
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if arguments.what == "list":
        return _list(arguments.config)
    with StatusClient(chosen_socket(arguments.socket, arguments.config)) as client:
        if arguments.what == "status":
            state = _state(client)
        else:
            on = arguments.what == "start"
            before = _state(client).get("attempts")
            client.ask("record", {"on": on})
            state = _wait_for(client, on=on, before=before)
    sys.stdout.write(_in_words(state) + "\n")
    return 0


def _wait_for(client: StatusClient, *, on: bool, before: object) -> Mapping[str, Any]:
    """Return the recorder's state when it is as wanted.

    Raises
    ------
    companion.errors.CompanionError
        When it does not come to that; says why.
    """
    end_s = time.monotonic() + _WAIT_S
    while time.monotonic() < end_s:
        state = _state(client)
        if state.get("recording") is on:
            return state
        if on and state.get("attempts") != before and state.get("reason"):
            raise CompanionError(f"not recording: {state['reason']}")
        time.sleep(_LOOK_S)
    raise CompanionError(f"the recorder did not {'begin' if on else 'end'} within {_WAIT_S:g} s; see the log")


def _state(client: StatusClient) -> Mapping[str, Any]:
    state = client.ask(STATUS).get("recorder")
    if not isinstance(state, dict):
        raise CompanionError('there is no recorder: recorder.start is "never"')
    return state


def _in_words(state: Mapping[str, Any]) -> str:
    if state.get("recording"):
        return f"recording ({state['begun_by']}): {state['file']}, {state['bytes'] / MIB:.1f} MiB"
    reason = state.get("reason")
    return f"not recording: {reason}" if reason else "not recording"


def _list(config: str | None) -> int:
    loaded = load(ConfigPlaces(Path(config) if config else None, dict(os.environ))).config
    folder = folder_of(loaded, os.environ)
    for recording in recordings(folder):
        sys.stdout.write(f"{recording.size_bytes / MIB:9.1f} MiB  {recording.path}\n")
    return 0
