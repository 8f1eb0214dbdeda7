"""A page that is served, with a flight published to it, for the tests of this folder."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config
from companion.config_file import config_of
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA
from companion.web.sink import LivePage, build
from tests.companion.web.showcase import FakeDesk, Looked, Showcase, config_message, look_at_the_walk

SETTINGS_TOML = """\
# The hall on the second floor.
[guidance]
max_step_m = 1.2  # careful indoors

# The camera points a little up.
[camera]
mount_pitch_deg = 4.0
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Served:
    """A page at work."""

    def __init__(self, page: LivePage, desk: FakeDesk, port: int, settings_file: Path) -> None:
        self.page, self.desk, self.port, self.settings_file = page, desk, port, settings_file
        self.url = f"http://127.0.0.1:{port}"


def config_for(port: int, settings_file: Path, **web: Any) -> Config:
    table = {
        "enabled": True,
        "port": port,
        "settings_file": str(settings_file),
        "recordings": str(OFFICE_WALK),
        **web,
    }
    return config_of(
        {
            "web": table,
            "camera": {"file": str(OFFICE_WALK_CAMERA), "mount_pitch_deg": 4.0},
            "guidance": {"max_step_m": 1.2},
        },
        name="test",
    )


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    """Serve a page with further keys of [web]; it is gone at the end of the test."""
    with ExitStack() as stack:

        def start(**web: Any) -> Served:
            settings_file = tmp_path / "config.toml"
            settings_file.write_text(SETTINGS_TOML)
            port = web.pop("port", None) or free_port()
            config = config_for(port, settings_file, **web)
            desk = FakeDesk(config)
            page = build(config, desk)
            desk.page = page
            page.start()
            stack.callback(_stop, page)
            page.take(config_message(config))
            return Served(page, desk, port, settings_file)

        yield start


def _stop(page: LivePage) -> None:
    page.stop()
    left = [thread.name for thread in threading.enumerate() if thread.name == "web" and thread.is_alive()]
    for thread in threading.enumerate():
        if thread.name == "web":
            thread.join(20.0)
    assert not any(thread.name == "web" for thread in threading.enumerate()), left


@pytest.fixture(scope="session")
def looked() -> list[Looked]:
    """Pictures of the walk with what the detector made of them."""
    return look_at_the_walk("parallax", 6)


@pytest.fixture(scope="session")
def looked_by_paper() -> list[Looked]:
    return look_at_the_walk("paper", 6)


@pytest.fixture
def flying(serve: Callable[..., Served], looked: list[Looked]) -> Iterator[Served]:
    """A page with a flight published to it."""
    served = serve()
    with Showcase(served.page, served.desk, looked, rate_hz=8.0):
        yield served
