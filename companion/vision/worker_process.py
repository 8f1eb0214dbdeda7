"""One worker process as the service sees it."""

from __future__ import annotations

from typing import Self

from companion.children.process import ChildProcess
from companion.vision.messages import (
    MAX_PACKET_BYTES,
    FromWorker,
    ToWorker,
    pack_to_worker,
    unpack_from_worker,
)


class WorkerProcess(ChildProcess):
    """A running worker. It has no state worth saving: it is killed, not asked."""

    @classmethod
    def start(cls, threads: int) -> Self:
        """Start the process. Blocks for some milliseconds; see `ChildProcess.start_module`.

        Raises
        ------
        OSError
            When there are too many processes or open files, or too little memory.
        """
        return cls.start_module("companion.vision.child_process", threads=threads)

    def send(self, message: ToWorker, fd: int | None = None) -> None:
        """Send a message, with a file descriptor where given. Never blocks.

        Raises
        ------
        OSError
            When the worker is gone or does not read.
        """
        self.send_packet(pack_to_worker(message), fd)

    def receive(self) -> FromWorker | None:
        """Return the next message, or None when the worker has closed its side. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is no message.
        companion.vision.messages.MessageError
            When what came is none.
        """
        packet = self.receive_packet(MAX_PACKET_BYTES)
        return unpack_from_worker(packet) if packet else None
