"""The I/O process as the service sees it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import ClassVar, Final, Self

from companion.children.process import ChildProcess
from companion.config import Config
from companion.io.messages import MAX_PACKET_BYTES, FromIo, unpack_from_io

_SEND_BUFFER_BYTES: Final = 1 << 20
_MEMORY: Final = {"MALLOC_MMAP_THRESHOLD_": str(1 << 16), "MALLOC_TRIM_THRESHOLD_": str(1 << 17)}
"""Blocks from 64 KiB on, which frames and chunks are, go back to the system when they are let go of (mallopt(3)). By itself glibc raises these with the largest block that
it has seen, and the process then keeps what a full file or a slow disk once took."""


class IoProcess(ChildProcess):
    """A running I/O process."""

    gone_s: ClassVar[float] = 0.3

    @classmethod
    def start(cls, config: Config, sinks: Sequence[str]) -> Self:
        """Start the process with its sinks. Blocks for some milliseconds; see `ChildProcess.start_module`.

        Raises
        ------
        OSError
            When there are too many processes or open files, or too little memory.
        """
        # One thread for arithmetic: it is not what this process is for, and the cores are the detector's.
        started = cls.start_module(
            "companion.io.child_process",
            threads=1,
            send_buffer_bytes=_SEND_BUFFER_BYTES,
            environment=_MEMORY,
        )
        first = {"sinks": list(sinks), "config": config.model_dump_json(exclude_unset=True)}
        try:
            started.send_packet(json.dumps(first).encode())
        except OSError:
            started.stop()
            raise
        return started

    def receive(self) -> FromIo | None:
        """Return the next message, or None when the process has closed its side. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is no message.
        companion.io.messages.PacketError
            When what came is none.
        """
        packet = self.receive_packet(MAX_PACKET_BYTES)
        return unpack_from_io(packet) if packet else None
