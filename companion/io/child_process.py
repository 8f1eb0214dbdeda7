"""The I/O process: takes what the service publishes and hands it to its sinks.

Started by ``companion.io.process`` as ``python -m companion.io.child_process PARENT_PID SOCKET_FD``. It ends when its socket
is closed, after its sinks have stopped or a second later, and when its parent dies in whatever way.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import json
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from typing import Final, cast

from companion.children.parent import die_with_parent
from companion.config import Config
from companion.errors import ConfigError
from companion.io.messages import (
    MAX_PACKET_BYTES,
    FromIo,
    Kind,
    Message,
    Ready,
    Unusable,
    Wanted,
    pack_from_io,
)
from companion.io.receiver import Receiver
from companion.io.sink import SinkFactory
from companion.io.sink_thread import Outbox, SinkThread

_STOP_S: Final = 1.0
_LOWER_PRIORITY: Final = 10


def main() -> int:
    """Run the I/O process; return its exit status."""
    parent_pid, socket_fd = (int(argument) for argument in sys.argv[1:3])
    for number in (signal.SIGINT, signal.SIGTERM):
        # Both come to all processes of a terminal or of a systemd unit; the service then ends this process, files closed.
        signal.signal(number, signal.SIG_IGN)
    faulthandler.enable()
    die_with_parent(parent_pid)
    with contextlib.suppress(OSError):
        os.nice(_LOWER_PRIORITY)  # flying comes first
    with socket.socket(fileno=socket_fd) as connection:
        status = _serve(connection)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # without waiting for threads that a sink may have left


def _serve(connection: socket.socket) -> int:
    def send(message: FromIo) -> None:
        connection.send(pack_from_io(message))

    start = connection.recv(MAX_PACKET_BYTES)
    if not start:
        return 0
    outbox = Outbox(send)
    table = json.loads(start)
    threads: list[SinkThread] = []
    try:
        config = Config.model_validate_json(table["config"])

        telling = threading.Lock()

        def tell_wants() -> None:
            with telling:  # so that what is said last is what holds
                outbox.send(wanted_by(threads))

        for name in table["sinks"]:
            thread = SinkThread(name, outbox, tell_wants)
            threads.append(thread)
            thread.build(load_factory(name), config)
    except ConfigError as error:
        outbox.send(Unusable(str(error)))
        return 1
    except Exception:  # noqa: BLE001  whatever it is, the service gets to know before the end
        traceback.print_exc()
        return 1
    outbox.send(Ready())
    receiver, lost_frames = Receiver(), 0
    try:
        while True:
            packet, fds, _, _ = socket.recv_fds(connection, MAX_PACKET_BYTES, 1)
            if not packet:
                break
            messages = list(receiver.messages(packet, fds))
            if receiver.lost_frames > lost_frames:
                lost_frames = receiver.lost_frames
                lost = {"name": "dropped", "by": "ring", "counts": {"frame": lost_frames}}
                messages.append(
                    Message(Kind.CONTROL, time.monotonic_ns(), messages[-1].seq if messages else 0, lost)
                )
            for message in messages:
                if message.kind is Kind.ANSWER:
                    outbox.on_answer(message.fields)
                    continue
                for thread in threads:
                    thread.put(message)
    except ConnectionError:
        pass
    outbox.close()
    return 0 if stop_all(threads, _STOP_S) else 1


def wanted_by(threads: Sequence[SinkThread]) -> Wanted:
    """Return what several sinks want together."""
    wants = [thread.wants for thread in threads]
    rates = [want.frames_hz for want in wants if Kind.FRAME in want.kinds]
    every_frame = not rates or 0.0 in rates
    return Wanted(frozenset().union(*(want.kinds for want in wants)), 0.0 if every_frame else max(rates))


def stop_all(threads: Sequence[SinkThread], within_s: float) -> bool:
    """Stop all sinks side by side; return whether all have ended in time."""
    for thread in threads:
        thread.end()
    deadline_s = time.monotonic() + within_s
    have_ended = [thread.join(max(0.0, deadline_s - time.monotonic())) for thread in threads]
    return all(have_ended)


def load_factory(name: str) -> SinkFactory:
    """Return the factory of a name in the form ``package.module:function``.

    Raises
    ------
    companion.errors.ConfigError
        When something that it needs is not installed.
    """
    module_name, _, function_name = name.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{module_name} needs {error.name}, which is not installed") from error
    return cast("SinkFactory", getattr(module, function_name))


if __name__ == "__main__":
    sys.exit(main())
