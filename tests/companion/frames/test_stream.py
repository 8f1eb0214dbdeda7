"""Streams over loopback, decoded by FFmpeg: RTSP with a server of our own, MPEG-TS over UDP."""

import asyncio
import io
import json
import socket
import threading

import cv2
import numpy as np
import pytest

from companion.clock import RealClock
from companion.config import LogConfig, SourceConfig
from companion.errors import SourceError
from companion.frames.open import capture_opener, open_source
from companion.log import open_log
from tests.fakes.rtsp_server import PACKET_BYTES, RtspServer

PERIOD_S = 0.004


@pytest.fixture(scope="module")
def transport_stream(tmp_path_factory) -> bytes:
    """Ten seconds of a bright square that crosses a dark picture."""
    path = tmp_path_factory.mktemp("stream") / "square.ts"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"MPG2"), 25, (160, 120))
    assert writer.isOpened()
    for number in range(250):
        image = np.full((120, 160, 3), 40, np.uint8)
        image[40:80, number % 120 : number % 120 + 40] = 220
        writer.write(image)
    writer.release()
    return path.read_bytes()


@pytest.fixture
def events():
    stream = io.StringIO()
    with open_log(LogConfig(), stream) as log:
        yield log, lambda: [json.loads(line) for line in stream.getvalue().splitlines()]


async def next_of(frames):
    async with asyncio.timeout(40):
        return await anext(frames)


def check(frame) -> None:
    assert frame.image.shape == (120, 160)
    assert frame.time_of == "arrival"
    assert abs(int(frame.image[5, 5]) - 40) < 25
    assert frame.image.max() > 180


@pytest.mark.parametrize("trouble", ["closed", "silent"])
async def test_rtsp_is_played_and_played_again_after_trouble(transport_stream, events, trouble):
    log, said = events
    with RtspServer(transport_stream, PERIOD_S) as server:
        config = SourceConfig(url=f"rtsp://somebody:secret@127.0.0.1:{server.port}/", timeout_s=0.5)
        async with open_source(config, clock=RealClock(), log=log) as source:
            frames = source.frames()
            for _ in range(3):
                check(await next_of(frames))
            if trouble == "closed":
                server.drop_connections()
            else:
                server.silent.set()
            async with asyncio.timeout(40):
                while not any(record["event"] == "camera_lost" for record in said()):  # noqa: ASYNC110  another thread's doing
                    await asyncio.sleep(0.01)
            server.silent.clear()
            mark = source.counts.reconnects
            while source.counts.reconnects == mark:
                check(await next_of(frames))
            check(await next_of(frames))
        assert server.connections >= 2
    assert "secret" not in json.dumps(said())


async def test_a_transport_stream_over_udp_is_played(transport_stream, events):
    stopping = threading.Event()

    def send(port: int) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            at = 0
            while not stopping.wait(PERIOD_S):
                sender.sendto(transport_stream[at : at + PACKET_BYTES], ("127.0.0.1", port))
                at = at + PACKET_BYTES if at + PACKET_BYTES < len(transport_stream) else 0

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    thread = threading.Thread(target=send, args=(port,))
    thread.start()
    try:
        config = SourceConfig(url=f"udp://127.0.0.1:{port}", timeout_s=2.0)
        async with open_source(config, clock=RealClock(), log=events[0]) as source:
            frames = source.frames()
            for _ in range(3):
                check(await next_of(frames))
    finally:
        stopping.set()
        thread.join()


def test_nobody_there_is_said_without_the_password():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(SourceError) as caught:
        capture_opener(SourceConfig(url=f"rtsp://somebody:secret@127.0.0.1:{port}/cam"))()
    assert (
        str(caught.value) == f"rtsp://127.0.0.1:{port}/cam: no stream within 5 s, or none that can be decoded"
    )
