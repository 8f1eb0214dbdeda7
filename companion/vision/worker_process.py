"""One worker process as the service sees it: started, spoken to, killed.

A fresh interpreter, never a fork: the service has threads. What blocks (``start``, ``stop``) says so; the rest
never does.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import IO

from companion.vision.messages import (
    MAX_PACKET_BYTES,
    FromWorker,
    ToWorker,
    pack_to_worker,
    unpack_from_worker,
)

_GONE_S = 1.0
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class WorkerProcess:
    """A running worker process, its socket, and the pipe that its standard output and error end in."""

    def __init__(
        self, process: subprocess.Popen[bytes], connection: socket.socket, output: IO[bytes]
    ) -> None:
        self._process = process
        self._connection = connection
        self._output = output

    @classmethod
    def start(cls, threads: int) -> WorkerProcess:
        """Start the process. Blocks for some milliseconds.

        The kernel kills the process when the *thread* that called this ends, so that thread has to last.

        Parameters
        ----------
        threads
            OpenMP and BLAS threads of the process; they have to be known before it imports anything.

        Raises
        ------
        OSError
            When there are too many processes or open files, or too little memory.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                process = subprocess.Popen(
                    [
                        *(sys.executable, "-P", "-m", "companion.vision.child_process"),
                        *(str(os.getpid()), str(theirs.fileno())),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    pass_fds=(theirs.fileno(),),
                    env=_environment(threads),
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
        """Readable when ``receive`` has something to say."""
        return self._connection.fileno()

    @property
    def output_fd(self) -> int:
        """Readable when ``read_output`` has something to say."""
        return self._output.fileno()

    def send(self, message: ToWorker, fd: int | None = None) -> None:
        """Send a message, with a file descriptor where given. Never blocks.

        Raises
        ------
        OSError
            When the worker is gone or does not read.
        """
        packet = pack_to_worker(message)
        if fd is None:
            self._connection.send(packet)
        else:
            socket.send_fds(self._connection, [packet], [fd])

    def receive(self) -> FromWorker | None:
        """Return the next message, or None when the worker has closed its side. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is no message.
        companion.vision.messages.MessageError
            When what came is none.
        """
        try:
            packet = self._connection.recv(MAX_PACKET_BYTES)
        except ConnectionError:
            return None
        return unpack_from_worker(packet) if packet else None

    def read_output(self) -> bytes:
        """Return what it wrote to its standard output or error; empty at the end. Never blocks.

        Raises
        ------
        BlockingIOError
            When there is nothing now.
        """
        return os.read(self._output.fileno(), 1 << 16)

    def kill(self) -> None:
        """Send SIGKILL; it has no state worth saving, and a hung one heeds nothing else. Never blocks."""
        self._process.kill()

    def stop(self, grace_s: float = 0.0) -> int | None:
        """Kill the process, wait until it is gone, and close what belongs to it. Blocks.

        Parameters
        ----------
        grace_s
            Time to end by itself, where it is about to: its own exit status says more than our signal.

        Returns
        -------
        The exit status (negative: the signal), or None when the kernel has not let go of it after a second.
        """
        self._connection.close()
        if grace_s > 0:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(grace_s)
        self._process.kill()
        try:
            return self._process.wait(_GONE_S)
        except subprocess.TimeoutExpired:  # in uninterruptible I/O; it dies as soon as that ends
            return None
        finally:
            self._output.close()


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
