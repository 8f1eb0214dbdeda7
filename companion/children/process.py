"""A child process as the service sees it: started, spoken to, ended.

A fresh interpreter, never a fork: the service has threads. What blocks (`ChildProcess.start`, `ChildProcess.stop`) says so; the
rest never does.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import IO, ClassVar, Final, Self

_THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


_NONE: Final[Mapping[str, str]] = MappingProxyType({})


class ChildProcess:
    """A running process, its socket, and the pipe that its standard output and error end in."""

    gone_s: ClassVar[float] = 1.0
    """How long the kernel is given to let go of it after SIGKILL."""

    def __init__(
        self, process: subprocess.Popen[bytes], connection: socket.socket, output: IO[bytes]
    ) -> None:
        self._process = process
        self._connection = connection
        self._output = output

    @classmethod
    def start_module(
        cls,
        module: str,
        *,
        threads: int,
        send_buffer_bytes: int | None = None,
        environment: Mapping[str, str] = _NONE,
    ) -> Self:
        """Start ``python -m module PARENT_PID SOCKET_FD``. Blocks for some milliseconds.

        A module that calls `companion.children.parent.die_with_parent` is killed by the kernel when the *thread* that called
        this ends, so that thread has to last.

        Parameters
        ----------
        module
            What it runs.
        threads
            OpenMP and BLAS threads of the process; they have to be known before it imports anything.
        send_buffer_bytes
            What may wait in the kernel while the process is busy (it may grant less); None: as it is by default.
        environment
            Variables of this process alone; where ours has one of them set, that counts.

        Raises
        ------
        OSError
            When there are too many processes or open files, or too little memory.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if send_buffer_bytes is not None:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer_bytes)
        with theirs:
            try:
                process = subprocess.Popen(
                    [sys.executable, "-P", "-m", module, str(os.getpid()), str(theirs.fileno())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    pass_fds=(theirs.fileno(),),
                    env={**environment, **_environment(threads)},
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
        return cls(process, ours, output)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def message_fd(self) -> int:
        """Readable when `receive_packet` has something to say."""
        return self._connection.fileno()

    @property
    def output_fd(self) -> int:
        """Readable when `read_output` has something to say."""
        return self._output.fileno()

    def send_packet(self, packet: bytes, fd: int | None = None) -> None:
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

    def receive_packet(self, max_bytes: int) -> bytes:
        """Return the next packet; empty when the process has closed its side. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is none.
        """
        try:
            return self._connection.recv(max_bytes)
        except ConnectionError:
            return b""

    def read_output(self) -> bytes:
        """Return what it wrote to its standard output or error; empty at the end. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is nothing now.
        """
        return os.read(self._output.fileno(), 1 << 16)

    def kill(self) -> None:
        """Send SIGKILL: a hung process heeds nothing else. Never blocks."""
        self._process.kill()

    def stop(self, grace_s: float = 0.0) -> int | None:
        """Ask the process to end by closing its socket, kill it when it has not after ``grace_s``. Blocks.

        Returns
        -------
        The exit status (negative: the signal), or None when the kernel has not let go of it after `gone_s`.
        """
        self._connection.close()
        try:
            return self._wait(grace_s)
        finally:
            self._output.close()

    def _wait(self, grace_s: float) -> int | None:
        if grace_s > 0:
            try:
                return self._process.wait(grace_s)
            except subprocess.TimeoutExpired:
                pass
        self._process.kill()
        try:
            return self._process.wait(self.gone_s)
        except subprocess.TimeoutExpired:  # in uninterruptible I/O; it dies as soon as that ends
            return None


def status_in_words(status: int | None) -> str:
    """Return an exit status as people say it."""
    if status is None:
        return "still there after SIGKILL"
    if status >= 0:
        return f"exit status {status}"
    try:
        return signal.Signals(-status).name
    except ValueError:
        return f"signal {-status}"


def _environment(threads: int) -> dict[str, str]:
    # The same modules as here, in the same order, without the current folder sneaking in.
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    return {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads)), "PYTHONPATH": path}
