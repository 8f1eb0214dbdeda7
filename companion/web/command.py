"""``companion web RECORDING|DIR``: the page without a drone: recordings, and the settings file."""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import sys
from pathlib import Path

from companion.config import Config
from companion.config_sources import ConfigPlaces, load
from companion.errors import CompanionError


def web_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion web``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(
        prog="companion web",
        description="Serves the page with recordings: step through them, and compare settings on them. "
        "The page of a running service: [web] enabled = true.",
    )
    parser.add_argument(
        "recording",
        metavar="RECORDING|DIR",
        help="a recording, a video, a folder of images, or a folder of these",
    )
    parser.add_argument("-c", "--config", metavar="FILE.toml", help="settings to begin from, and to save to")
    parser.add_argument(
        "-o",
        "--option",
        metavar="TABLE.KEY=VALUE",
        action="append",
        default=[],
        help="one value; may be repeated",
    )
    parser.add_argument("--port", type=int, metavar="N", help="TCP port (default: web.port)")
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    places = ConfigPlaces(
        Path(arguments.config) if arguments.config else None, dict(os.environ), tuple(arguments.option)
    )
    config = load(places).config
    root = Path(arguments.recording)
    if not root.exists():
        raise CompanionError(f"{root}: no such file or folder")
    port = config.web.port if arguments.port is None else arguments.port
    if not 0 <= port <= 65535:
        raise CompanionError(f"--port {port}: allowed: 0 to 65535")
    try:
        from companion.web.studio import list_recordings

        if not list_recordings(root):
            raise CompanionError(f"{root}: no recording, video or folder of images in it")
        asyncio.run(_serve(config, root, port, places.file))
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "websockets", "tomlkit"):
            raise
        raise CompanionError(
            f"the page needs {error.name}, which is not installed. Run: pip install 'void-companion[web]'"
        ) from error
    return 0


async def _serve(config: Config, root: Path, port: int, file: Path | None) -> None:
    from companion.web.application import Parts, make_application
    from companion.web.security import Gate, read_token
    from companion.web.server import PageServer, listen
    from companion.web.settings import SettingsDesk
    from companion.web.settings_file import SettingsFile
    from companion.web.studio import Studio

    web = config.web
    settings = SettingsDesk(config, SettingsFile.of(config, file))
    studio = Studio(root, lambda: settings.active, lambda: "")
    parts = Parts(Gate(web.host, read_token(web.token_file)), None, settings, studio)
    server = PageServer(make_application(parts), max_clients=web.max_clients)
    try:
        listener = listen(web.host, port)
    except OSError as error:
        raise CompanionError(
            f"{web.host}:{port}: cannot be served at: {error.strerror}. Another port: --port N"
        ) from error
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, server.stop)
    host = f"[{web.host}]" if ":" in web.host else web.host
    sys.stdout.write(f"http://{host}:{listener.getsockname()[1]}/  (Ctrl-C ends it)\n")
    sys.stdout.flush()
    await server.serve(listener)
