import asyncio
import contextlib
import io
import itertools
import json
import struct
import threading
import time

import numpy as np
import pytest

from companion.clock import RealClock
from companion.config import LogConfig, SourceConfig
from companion.frames.open import open_source
from companion.frames.socket import HEADER, FrameHeader, FrameStreamError, SocketSource, frame_bytes
from companion.log import open_log

IMAGE = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


def now_frame(seq: int, offset_s: float = 0.0) -> bytes:
    return frame_bytes(
        IMAGE + np.uint8(seq), seq=seq, time_ns=max(0, time.monotonic_ns() + round(offset_s * 1e9))
    )


async def until(holds) -> None:
    """Wait for what another thread does."""
    for _ in range(2000):
        if holds():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never came to hold")


@contextlib.asynccontextmanager
async def sender(talk, port: int = 0):
    """Serve each connection with `talk(reader, writer)`."""
    talks: list[asyncio.Task] = []

    async def serve(reader, writer):
        talks.append(asyncio.current_task())
        with contextlib.suppress(ConnectionError):
            await talk(reader, writer)
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()

    server = await asyncio.start_server(serve, "127.0.0.1", port)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        await asyncio.gather(*talks)


@pytest.fixture
def events():
    stream = io.StringIO()
    with open_log(LogConfig(), stream) as log:
        yield log, lambda: [json.loads(line) for line in stream.getvalue().splitlines()]


async def first_frames(port: int, log, count: int, **settings):
    frames = []
    async with SocketSource("127.0.0.1", port, clock=RealClock(), log=log, **settings) as source:
        async with asyncio.timeout(20):
            async for frame in source.frames():
                frames.append(frame)
                if len(frames) == count:
                    return frames, source.counts
    raise AssertionError("the source ended by itself")


async def test_frames_arrive_as_they_were_sent(events):
    sent_ns = time.monotonic_ns()

    async def talk(reader, writer):
        for seq in range(3):
            writer.write(frame_bytes(IMAGE + np.uint8(seq), seq=seq + 7, time_ns=sent_ns + seq))
            await writer.drain()
            await asyncio.sleep(0.1)
        await reader.read()

    async with sender(talk) as port:
        frames, counts = await first_frames(port, events[0], 3)
    assert [frame.seq for frame in frames] == [7, 8, 9]
    assert [frame.time_ns for frame in frames] == [sent_ns, sent_ns + 1, sent_ns + 2]
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, IMAGE + np.uint8(i))
    assert counts.delivered == 3


async def test_the_newest_frame_wins(events):
    async def talk(reader, writer):
        for seq in range(50):
            writer.write(now_frame(seq))
        await writer.drain()
        await reader.read()

    async with (
        sender(talk) as port,
        SocketSource("127.0.0.1", port, clock=RealClock(), log=events[0]) as source,
    ):
        await until(lambda: source.counts.skipped_late == 49)
        frame = await anext(source.frames())
    assert frame.seq == 49


async def test_it_connects_again_when_the_sender_goes_and_when_it_sends_garbage(events):
    after_a_good_frame = [
        b"",  # closes
        b"GET / HTTP/1.1\r\nHost: somewhere\r\n\r\n",
        now_frame(0)[:40],  # closes within a frame
        HEADER.pack(b"VCF1", 9000, 9000, 0, 0, 0, 81_000_000),
        HEADER.pack(b"VCF1", 64, 48, 0, 0, 0, 7),
        HEADER.pack(b"VCF1", 0, 0, 0, 0, 0, 0),
    ]
    connections = itertools.count()

    async def talk(reader, writer):
        number = next(connections)
        writer.write(now_frame(number))
        if number >= len(after_a_good_frame):
            await reader.read()
            return
        writer.write(after_a_good_frame[number])
        await writer.drain()

    async with sender(talk) as port:
        frames, counts = await first_frames(port, events[0], 7)
    assert [frame.seq for frame in frames] == list(range(7))
    assert counts.reconnects == 6
    await asyncio.sleep(0.1)
    reasons = [record["reason"] for record in events[1]() if record["event"] == "frame_stream_lost"]
    assert [reason.split(";")[0] for reason in reasons] == [
        "closed by the sender",
        "found b'GET ' where a frame starts with b'VCF1'",
        "closed by the sender within a frame",
        "found a frame of 9000 x 9000 px",
        "found a payload of 7 bytes for 64 x 48 px of one byte each",
        "found a frame of 0 x 0 px",
    ]


async def test_silence_is_not_waited_out(events):
    connections = []

    async def talk(reader, writer):
        connections.append(1)
        if len(connections) > 1:
            writer.write(now_frame(5))
        await reader.read()

    async with sender(talk) as port:
        frames, _ = await first_frames(port, events[0], 1, timeout_s=0.2)
    assert frames[0].seq == 5
    assert len(connections) == 2


async def test_a_sender_that_is_not_there_yet_is_waited_for_and_announced_once(events):
    async with sender(lambda reader, writer: asyncio.sleep(0)) as port:
        pass  # the port is free again

    async def talk(reader, writer):
        writer.write(now_frame(1))
        await reader.read()

    source = SocketSource("127.0.0.1", port, clock=RealClock(), log=events[0])

    async def receive():
        async with source:
            return await anext(source.frames())

    receiving = asyncio.create_task(receive())
    await asyncio.sleep(0.5)
    async with sender(talk, port), asyncio.timeout(20):
        frame = await receiving
    assert frame.seq == 1
    await asyncio.sleep(0.1)
    assert [record["event"] for record in events[1]()] == ["frame_stream_lost", "frame_stream_connected"]


async def test_times_that_cannot_be_are_refused_and_counted(events):
    async def talk(reader, writer):
        for seq, offset_s in ((1, 3600.0), (2, -3600.0), (3, 0.0), (4, -1.0)):
            writer.write(now_frame(seq, offset_s))
        await writer.drain()
        await asyncio.sleep(0.1)
        writer.write(now_frame(5))
        await reader.read()

    async with sender(talk) as port:
        frames, counts = await first_frames(port, events[0], 2)
    assert [frame.seq for frame in frames] == [3, 5]
    assert counts.time_refused == 3
    await asyncio.sleep(0.1)
    assert [r["event"] for r in events[1]()].count("frame_time_refused") == 1


async def test_closing_while_waiting_for_data_leaves_no_thread(events):
    async def talk(reader, writer):
        await reader.read()

    async with sender(talk) as port:
        async with SocketSource("127.0.0.1", port, clock=RealClock(), log=events[0], timeout_s=30):
            await asyncio.sleep(0.1)
            assert "frame-receiver" in {thread.name for thread in threading.enumerate()}
        assert "frame-receiver" not in {thread.name for thread in threading.enumerate()}


async def test_the_configuration_names_the_address(events):
    async def talk(reader, writer):
        writer.write(now_frame(4))
        await reader.read()

    async with sender(talk) as port:
        config = SourceConfig(url=f"tcp:127.0.0.1:{port}")
        async with open_source(config, clock=RealClock(), log=events[0]) as source:
            assert (await anext(source.frames())).seq == 4


def test_the_header_is_32_bytes_as_documented():
    header = FrameHeader(640, 480, 3, 5_000_000_000)
    packed = header.pack()
    assert packed == struct.pack("<4sHHIQQI", b"VCF1", 640, 480, 3, 5_000_000_000, 0, 640 * 480)
    assert len(packed) == 32
    assert FrameHeader.unpack(packed) == header
    with pytest.raises(FrameStreamError):
        FrameHeader.unpack(b"\0" * 32)
