"""The worker process: reads frames from shared memory, runs the pipeline, answers.

Started by ``worker_process`` as ``python -m companion.vision.child_process PARENT_PID SOCKET_FD``. It ends
when its socket is closed, when its parent dies in whatever way, and after an exception.
"""

from __future__ import annotations

import contextlib
import faulthandler
import signal
import socket
import sys
import traceback

from companion.children.parent import die_with_parent
from companion.errors import ConfigError
from companion.frames.source import Frame
from companion.io.messages import pack_arrays
from companion.vision.frame_slots import MappedSlots
from companion.vision.messages import (
    MAX_PACKET_BYTES,
    Answer,
    Details,
    Detect,
    Failed,
    FromWorker,
    MapSlots,
    Ready,
    Start,
    ToWorker,
    Unusable,
    pack_from_worker,
    unpack_to_worker,
)
from companion.vision.pipeline import Pipeline, WithDetails, WithIdleWork, load_factory

_MAX_TRACEBACK = 20_000


def main() -> int:
    """Run the worker process; return its exit status."""
    parent_pid, socket_fd = (int(argument) for argument in sys.argv[1:3])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the service, which ends this process
    faulthandler.enable()
    die_with_parent(parent_pid)
    with socket.socket(fileno=socket_fd) as connection:
        try:
            return _serve(connection)
        except Exception as error:  # noqa: BLE001  whatever it is, the service gets to know before the end
            text = traceback.format_exc()[-_MAX_TRACEBACK:]
            with contextlib.suppress(OSError):
                _send(connection, Failed(f"{type(error).__name__}: {error}"[:500], text))
            return 1


def _serve(connection: socket.socket) -> int:
    pipeline: Pipeline | None = None
    slots: MappedSlots | None = None
    while (received := _receive(connection)) is not None:
        message, fds = received
        match message:
            case Start():
                try:
                    pipeline = load_factory(message.pipeline)(message.detector, message.camera)
                except ConfigError as error:
                    _send(connection, Unusable(str(error)[:_MAX_TRACEBACK]))
                    return 1
                _send(connection, Ready())
            case MapSlots():
                if slots is not None:
                    slots.close()
                slots = MappedSlots(fds[0], message.slot_bytes, message.n_slots)
            case Detect():
                if pipeline is None or slots is None:
                    raise RuntimeError("a frame came before the pipeline and its memory")
                image = slots.read(message.slot, message.height_px, message.width_px)
                report = pipeline.detect(Frame(image, message.time_ns, message.seq), message.pose)
                _send(connection, Answer(message.frame_id, report))
                if message.details and isinstance(pipeline, WithDetails):
                    _send_details(connection, message, pipeline)
                if isinstance(pipeline, WithIdleWork):
                    pipeline.between_frames()
    return 0


def _receive(connection: socket.socket) -> tuple[ToWorker, list[int]] | None:
    try:
        packet, fds, _, _ = socket.recv_fds(connection, MAX_PACKET_BYTES, 1)
    except ConnectionError:
        return None
    return (unpack_to_worker(packet), fds) if packet else None


def _send_details(connection: socket.socket, message: Detect, pipeline: WithDetails) -> None:
    fields, arrays = pipeline.details()
    layout, data = pack_arrays(arrays)
    fields = {"frame_seq": message.seq, "frame_ns": message.time_ns, **fields, "arrays": layout}
    from companion.log import json_line  # structlog, which nothing else here needs

    packet = pack_from_worker(Details(json_line(None, "", fields).encode(), data))
    if len(packet) <= MAX_PACKET_BYTES:
        connection.send(packet)


def _send(connection: socket.socket, message: FromWorker) -> None:
    connection.send(pack_from_worker(message))


if __name__ == "__main__":
    sys.exit(main())
