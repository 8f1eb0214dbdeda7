"""Endpoints that call one other side over a byte stream, and call again whenever it is lost: TCP clients and serial lines."""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from contextlib import suppress
from types import TracebackType
from typing import Self

from companion.mavlink.endpoint import Endpoint, reopen_delay_s
from companion.mavlink.stream import ByteStream


class CallingEndpoint(Endpoint):
    """Keeps one stream open, with back-off, for as long as it lives."""

    def __init__(self, url: str, name: str, *, max_waiting_bytes: int) -> None:
        super().__init__(url, name)
        self._max_waiting_bytes = max_waiting_bytes
        self._stream: ByteStream | None = None
        self._task: asyncio.Task[None] | None = None

    @abstractmethod
    async def _open(self) -> int:
        """Return the non-blocking descriptor of a fresh connection; OSError where there is none to be had."""

    @abstractmethod
    def _close(self) -> None:
        """Close what `_open` opened; nothing may be open."""

    async def __aenter__(self) -> Self:
        self._become("opening")
        self._task = asyncio.get_running_loop().create_task(self._keep_open(), name=self.name)
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        self._become("closed")

    @property
    def peer_names(self) -> tuple[str, ...]:
        """The other side, where it is connected."""
        return (self.url,) if self._stream is not None else ()

    def send(self, datagram: bytes) -> int:
        """Send whole frames and return 1 where they were taken. Never blocks, never raises."""
        if self._stream is None:
            self.counters.unheard_datagrams += 1
            return 0
        if not datagram or not self._stream.send(datagram):
            return 0
        self.counters.sent_datagrams += 1
        self.counters.sent_bytes += len(datagram)
        return 1

    async def _keep_open(self) -> None:
        failures = 0
        while True:
            try:
                fd = await self._open()
            except OSError as error:
                reason = error.strerror or str(error) or "no answer"
            else:
                received = self.counters.received_bytes
                reason = await self._until_lost(fd)
                if self.counters.received_bytes > received:
                    failures = 0
            self._become(f"waiting: {reason}")
            await asyncio.sleep(reopen_delay_s(failures))
            failures += 1

    async def _until_lost(self, fd: int) -> str:
        """Serve a connection to its end and return the reason."""
        lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()

        def on_lost(reason: str) -> None:
            if not lost.done():
                lost.set_result(reason)

        stream = ByteStream(
            fd,
            self.counters,
            on_frames=self._deliver,
            on_lost=on_lost,
            max_waiting_bytes=self._max_waiting_bytes,
        )
        self._stream = stream
        self._become("open")
        try:
            return await lost
        finally:
            self._stream = None
            stream.close()
            self._close()
