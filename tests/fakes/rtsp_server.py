"""An RTSP server that plays one MPEG transport stream over and over, interleaved with its own connection (RFC 2326, RFC 2250)."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from types import TracebackType
from typing import Self

PACKET_BYTES = 7 * 188
SDP = b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\nm=video 0 RTP/AVP 33\r\na=control:track0\r\n"


class RtspServer:
    """Serves ``rtsp://127.0.0.1:PORT/``. ``silent`` stops sending without closing."""

    def __init__(self, stream: bytes, packet_period_s: float) -> None:
        self._stream = stream
        self._period_s = packet_period_s
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.silent = threading.Event()
        self.connections = 0
        self._stopping = threading.Event()
        self._open: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept, name="rtsp-accept")]

    def __enter__(self) -> Self:
        self._threads[0].start()
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._stopping.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop_connections()
        for thread in self._threads:
            thread.join()

    def drop_connections(self) -> None:
        """Close every connection, as a camera that is switched off."""
        for connection in self._open:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while not self._stopping.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._open.append(connection)
            thread = threading.Thread(target=self._serve, args=(connection,), name="rtsp-serve")
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            while request := self._request(connection):
                method, _, headers = request
                head = f"RTSP/1.0 200 OK\r\nCSeq: {headers['cseq']}\r\n"
                body = b""
                match method:
                    case "OPTIONS":
                        head += "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
                    case "DESCRIBE":
                        body = SDP
                        head += f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
                    case "SETUP":
                        head += "Session: 1\r\nTransport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
                    case _:
                        head += "Session: 1\r\n"
                connection.sendall(head.encode() + b"\r\n" + body)
                if method == "PLAY":
                    self.connections += 1
                    self._play(connection)
                    return

    def _request(self, connection: socket.socket):
        data = b""
        while b"\r\n\r\n" not in data:
            received = connection.recv(4096)
            if not received:
                return None
            data += received
        lines = data.split(b"\r\n\r\n")[0].decode().split("\r\n")
        headers = {
            name.strip().lower(): value.strip()
            for name, _, value in (line.partition(":") for line in lines[1:])
        }
        method, url, _ = lines[0].split(" ")
        return method, url, headers

    def _play(self, connection: socket.socket) -> None:
        at = sequence = 0
        while not self._stopping.wait(self._period_s):
            if self.silent.is_set():
                continue
            payload = self._stream[at : at + PACKET_BYTES]
            at = at + PACKET_BYTES if at + PACKET_BYTES < len(self._stream) else 0
            header = struct.pack(">BBHII", 0x80, 33, sequence & 0xFFFF, sequence * 900, 7)
            connection.sendall(
                struct.pack(">BBH", ord("$"), 0, len(header) + len(payload)) + header + payload
            )
            sequence += 1
