"""Which event loop the service runs on: uvloop where it is installed (``pip install void-companion[fast]``), else asyncio's own."""

from __future__ import annotations

import asyncio
import importlib.util
from collections.abc import Callable
from typing import Literal

EventLoop = Literal["auto", "asyncio"]


def loop_factory(choice: EventLoop = "auto") -> Callable[[], asyncio.AbstractEventLoop]:
    """Return what makes the event loop.

    Parameters
    ----------
    choice
        ``auto``: uvloop where it is installed. ``asyncio``: never.
    """
    if choice == "auto" and importlib.util.find_spec("uvloop") is not None:
        import uvloop

        factory: Callable[[], asyncio.AbstractEventLoop] = uvloop.new_event_loop
        return factory
    return asyncio.new_event_loop
