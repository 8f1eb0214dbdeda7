"""The live page as a sink of the I/O process: takes what the flight publishes, serves it on a loop and thread of its own."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from companion.config import Config
from companion.io.messages import Answer, Kind, Message, Wants
from companion.io.sink import Desk
from companion.web.application import Parts, make_application
from companion.web.overlay import Projection
from companion.web.pictures import encode_jpeg, picture_message
from companion.web.security import Gate, read_token
from companion.web.server import PageServer, listen
from companion.web.settings import SettingsDesk
from companion.web.settings_file import SettingsFile
from companion.web.state import LiveState
from companion.web.studio import Studio
from companion.web.viewers import Viewers

_ALWAYS: Final = frozenset({Kind.STATE, Kind.STATUS, Kind.LINK, Kind.LOG, Kind.CONFIG})
"""Cheap, and what has happened before somebody looks."""
_WHILE_LOOKED_AT: Final = frozenset({Kind.POSE, Kind.SETPOINT, Kind.DETECTION})
_PICTURES: Final = frozenset({Kind.FRAME})
_DETAILS: Final = frozenset({Kind.DETAILS})
_ANSWER_S: Final = 90.0
"""A worker that is tried with new settings may take long to start."""
_STOP_S: Final = 0.9
_FREE_STATES: Final = ("", "DISENGAGED")


def build(config: Config, desk: Desk) -> LivePage:
    """Build the sink.

    Raises
    ------
    companion.errors.ConfigError
        When the token or the camera file cannot be used.
    """
    return LivePage(config, desk)


class LivePage:
    """Implements ``companion.io.sink.Sink``.

    Parameters
    ----------
    config
        With the table ``[web]``.
    desk
        Towards the service.
    """

    def __init__(self, config: Config, desk: Desk) -> None:
        self._web = config.web
        self._desk = desk
        self._lock = threading.Lock()
        self._state = LiveState(Projection(config.camera))
        self._gate = Gate(config.web.host, read_token(config.web.token_file))
        self._config = config
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._server: PageServer | None = None
        self._viewers: Viewers | None = None
        self._settings: SettingsDesk | None = None
        self._picture: bytes | None = None
        self._failure = ""

    def start(self) -> None:
        """Begin to serve; an address that cannot be had is tried again."""
        self._desk.want(Wants(_ALWAYS))
        self._try_to_serve()

    def take(self, message: Message) -> None:
        """Take one message."""
        if message.kind is Kind.FRAME and message.image is not None:
            self._take_frame(message)
        elif message.kind is Kind.CONFIG and self._settings is not None:
            self._settings.take_config(message.fields["active"])
        with self._lock:
            self._state.take(message)

    def idle(self) -> None:
        """Try again where the address could not be had."""
        if self._thread is None:
            self._try_to_serve()

    def stop(self) -> None:
        """End the server."""
        if self._server is not None:
            self._server.stop()
        if self._thread is not None:
            self._thread.join(_STOP_S)

    def _try_to_serve(self) -> None:
        web = self._web
        try:
            listener = listen(web.host, web.port)
        except OSError as error:
            if str(error) != self._failure:  # once, not at every attempt
                self._failure = str(error)
                self._desk.log.error("web_not_served", host=web.host, port=web.port, error=str(error))  # noqa: TRY400  one line, no traceback
            return
        ready = threading.Event()

        def run() -> None:
            with asyncio.Runner() as runner:
                runner.run(serve())

        async def serve() -> None:
            self._loop = asyncio.get_running_loop()
            self._viewers = viewers = Viewers(
                self._state, self._lock, max_clients=web.max_clients, on_change=self._tell_wants
            )
            path = Path(web.settings_file) if web.settings_file else None
            self._settings = settings = SettingsDesk(
                self._config, SettingsFile.of(self._config, path), self._apply
            )
            studio = Studio(_recordings(self._config), lambda: settings.active, self._why_not_compare)
            parts = Parts(self._gate, viewers, settings, studio)
            self._server = PageServer(make_application(parts), max_clients=web.max_clients)
            ready.set()
            ticking = asyncio.create_task(viewers.tick(), name="web-tick")
            try:
                await self._server.serve(listener)
            finally:
                ticking.cancel()

        self._thread = threading.Thread(target=run, name="web", daemon=True)
        self._thread.start()
        ready.wait()
        self._desk.log.info("web_serving", url=f"http://{web.host}:{web.port}/", token=self._gate.needs_token)

    def _take_frame(self, message: Message) -> None:
        image, loop, fields = message.image, self._loop, message.fields
        if image is None or loop is None:
            return
        jpeg = encode_jpeg(image, width_px=self._web.picture_width_px, quality=self._web.picture_quality)
        header = {
            "seq": fields["seq"],
            "t": message.time_ns / 1e9,
            "taken_ns": fields["taken_ns"],
            "width_px": fields["width_px"],
            "height_px": fields["height_px"],
        }
        picture = picture_message(header, jpeg)
        with self._lock:
            is_waiting, self._picture = self._picture is not None, picture
        if not is_waiting:  # else the loop will find this one in place of the one that waits
            loop.call_soon_threadsafe(self._hand_over)

    def _hand_over(self) -> None:
        with self._lock:
            picture, self._picture = self._picture, None
        if picture is not None and self._viewers is not None:
            self._viewers.add_picture(picture)

    def _tell_wants(self) -> None:
        viewers = self._viewers
        if viewers is None:
            return
        kinds = _ALWAYS
        if viewers.count:
            kinds |= _WHILE_LOOKED_AT
        if viewers.want_pictures:
            kinds |= _PICTURES
        if viewers.want_details:
            kinds |= _DETAILS
        self._desk.want(Wants(kinds, self._web.pictures_hz if viewers.want_pictures else 0.0))

    async def _apply(self, values: Mapping[str, Any]) -> Answer:
        try:
            async with asyncio.timeout(_ANSWER_S):
                return await asyncio.wrap_future(self._desk.ask("apply_settings", {"values": dict(values)}))
        except TimeoutError:
            return Answer(accepted=False, reasons=("the service has not answered",))

    def _why_not_compare(self) -> str:
        with self._lock:
            state = self._state.state
        if state in _FREE_STATES:
            return ""
        return f"not while setpoints are protected ({state}): the processor is the detector's"


def _recordings(config: Config) -> Path | None:
    """Return the folder of recordings: the one that is named, else the recorder's, else none."""
    if config.web.recordings:
        return Path(config.web.recordings)
    if config.recorder.start == "never" and not config.recorder.folder:
        return None
    from companion.recorder.sink import folder_of

    return folder_of(config, os.environ)
