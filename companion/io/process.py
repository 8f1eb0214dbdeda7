"""The I/O process as the service sees it: started, spoken to, ended.

A fresh interpreter, never a fork: the service has threads. What blocks (`IoProcess.start`, `IoProcess.stop`) says so; the
rest never does.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Final

from companion.config import Config
from companion.io.messages import MAX_PACKET_BYTES, FromIo, unpack_from_io

_GONE_S: Final = 0.3
_SEND_BUFFER_BYTES: Final = 1 << 20
"""What waits here while the process is busy (the kernel may grant less)."""


class IoProcess:
    """A running I/O process, its socket, and the pipe that its standard output and error end in."""

    def __init__(
        self, process: subprocess.Popen[bytes], connection: socket.socket, output: IO[bytes]
    ) -> None:
        self._process = process
        self._connection = connection
        self._output = output

    @classmethod
    def start(cls, config: Config, sinks: Sequence[str]) -> IoProcess:
        """Start the process with its sinks. Blocks for some milliseconds.

        The kernel kills the process when the *thread* that called this ends, so that thread has to last.

        Raises
        ------
        OSError
            When there are too many processes or open files, or too little memory.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        with theirs:
            try:
                process = subprocess.Popen(
                    [
                        *(sys.executable, "-P", "-m", "companion.io.child_process"),
                        *(str(os.getpid()), str(theirs.fileno())),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    pass_fds=(theirs.fileno(),),
                    env=_environment(),
                    start_new_session=True,  # a terminal's Ctrl-C goes to the service alone
                    bufsize=0,
                )
            except BaseException:
                ours.close()
                raise
        output = process.stdout
        if output is None:
            raise RuntimeError("started without a pipe for its output")
        ours.setblocking(False)
        os.set_blocking(output.fileno(), False)
        started = cls(process, ours, output)
        try:
            started.send(
                json.dumps(
                    {"sinks": list(sinks), "config": config.model_dump_json(exclude_unset=True)}
                ).encode()
            )
        except OSError:
            started.stop(0.0)
            raise
        return started

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def message_fd(self) -> int:
        """Readable when `receive` has something to say."""
        return self._connection.fileno()

    @property
    def output_fd(self) -> int:
        """Readable when `read_output` has something to say."""
        return self._output.fileno()

    def send(self, packet: bytes, fd: int | None = None) -> None:
        """Send a packet, with a file descriptor where given. Never blocks.

        Raises
        ------
        BlockingIOError
            When it does not read.
        OSError
            When it is gone.
        """
        if fd is None:
            self._connection.send(packet)
        else:
            socket.send_fds(self._connection, [packet], [fd])

    def receive(self) -> FromIo | None:
        """Return the next message, or None when the process has closed its side. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is no message.
        companion.io.messages.PacketError
            When what came is none.
        """
        try:
            packet = self._connection.recv(MAX_PACKET_BYTES)
        except ConnectionError:
            return None
        return unpack_from_io(packet) if packet else None

    def read_output(self) -> bytes:
        """Return what it wrote to its standard output or error; empty at the end. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is nothing now.
        """
        return os.read(self._output.fileno(), 1 << 16)

    def stop(self, grace_s: float) -> int | None:
        """Ask the process to end by closing the socket, kill it when it has not after ``grace_s``. Blocks.

        Returns
        -------
        Its exit status; None where the kernel has not let go of it.
        """
        self._connection.close()
        try:
            return self._wait(grace_s)
        finally:
            self._output.close()

    def _wait(self, grace_s: float) -> int | None:
        try:
            return self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
        try:
            return self._process.wait(_GONE_S)
        except subprocess.TimeoutExpired:  # in uninterruptible I/O; it dies as soon as that ends
            return None


def _environment() -> dict[str, str]:
    # The same modules as here, in the same order, without the current folder sneaking in. One thread for arithmetic: it is
    # not what this process is for, and the cores are the detector's.
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **threads, "PYTHONPATH": path}
