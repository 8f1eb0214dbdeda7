"""The recorder where it runs: its process is fed, ends in time, and what the kernel does not let it write ends the recording alone."""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import time
from pathlib import Path

import numpy as np
from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.config import Config
from companion.frames.source import Frame
from companion.io.desk import ServiceDesk
from companion.io.feed import Feed
from companion.io.messages import Kind
from companion.io.sinks import sinks_of, wanted_from_the_start
from companion.io.supervisor import IoSupervisor
from companion.recorder.reading import RecordingFile

DEADLINE_S = 60.0


async def until(condition):
    end_s = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert time.monotonic() < end_s, "did not come"
        await asyncio.sleep(0.01)
    return found


class Bench:
    """The I/O process with the real recorder, and what the service is told."""

    def __init__(self, folder: Path, **options) -> None:
        captured = CapturingLogger()

        def as_call(logger, method, event):
            return (event.pop("event"),), event

        log = wrap_logger(captured, processors=[as_call]).bind()
        self.calls = captured.calls
        self.said: list[str] = []
        options = {"folder": str(folder), "start": "always", "keep_free_mib": 0.0, **options}
        config = Config.model_validate({"recorder": options})
        self.feed = Feed()
        self.feed.want(wanted_from_the_start(config))
        desk = ServiceDesk(self.feed, self, now_ns=time.monotonic_ns, has_recorder=True, apply_settings=None)
        self.desk = desk
        self.io = IoSupervisor(
            self.feed, sinks_of(config), config, handlers=desk.handlers, now_ns=time.monotonic_ns, log=log
        )

    def status_text(self, severity, text):
        self.said.append(text)

    async def __aenter__(self):
        self.task = asyncio.create_task(self.io.run())
        return self

    async def __aexit__(self, *_):
        self.task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self.task
        self.feed.close()

    def logged(self, event):
        return [call.kwargs for call in self.calls if call.args == (event,)]

    def recorder(self):
        return self.desk.recorder_status(0)


async def test_a_recording_begins_with_the_service_and_ends_with_it(tmp_path):
    async with Bench(tmp_path, frames="png", frames_hz=0.0) as bench:
        for number in range(50):  # before the process is there
            bench.feed.mavlink(1, "in", b"\xfd\x00" + bytes(10), number)
        await until(lambda: bench.recorder().get("recording"))
        await until(lambda: bench.feed.wants(Kind.FRAME))
        for seq in range(20):
            bench.feed.frame(Frame(np.full((48, 64), seq, np.uint8), seq, seq), seq)
            await asyncio.sleep(0.03)
        bench.desk.record({"on": False})  # with all the time that it takes on a busy machine
        await until(lambda: bench.recorder().get("recording") is False)
    (path,) = tmp_path.glob("*.mcap")
    file = RecordingFile(path)
    found = list(file.messages())
    assert file.damage is None  # finished, with its index
    assert [m.time_ns for m in found if m.kind is Kind.MAVLINK] == list(range(50))
    frames = [m for m in found if m.kind is Kind.FRAME]
    assert len(frames) >= 5  # the newest, however late the process came to look
    assert frames[-1].fields["seq"] == 19
    assert all((m.image == m.fields["seq"]).all() for m in frames)


@contextlib.contextmanager
def no_file_longer_than(size_bytes: int):
    """Let files of the processes started meanwhile grow no further, as on a full disk: the kernel refuses the write."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


async def test_it_gives_memory_back_and_the_service_is_left_alone(tmp_path, monkeypatch):
    names = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")
    for name in names:
        monkeypatch.delenv(name, raising=False)
    bench = Bench(tmp_path)
    async with bench:
        await until(lambda: bench.recorder()["recording"])
        variables = Path(f"/proc/{bench.io.pid}/environ").read_text().split("\0")  # noqa: ASYNC240  of the kernel's own
        assert {f"{name}={kib * 1024}" for name, kib in zip(names, (64, 128), strict=True)} <= set(variables)
    assert not set(names) & set(os.environ)


async def test_a_disk_that_takes_no_more_ends_the_recording_and_nothing_else(tmp_path):
    bench = Bench(tmp_path, frames="png", frames_hz=0.0)
    with no_file_longer_than(300_000):
        await bench.__aenter__()
        await until(lambda: bench.io.pid)
    try:
        await until(lambda: bench.feed.wants(Kind.FRAME))
        rng, seq = np.random.default_rng(1), 0
        while not bench.logged("recording_stopped"):
            seq += 1
            bench.feed.frame(Frame(rng.integers(0, 255, (240, 320), np.uint8), seq, seq), seq)
            await asyncio.sleep(0.01)
            assert seq < 5000
        await until(lambda: bench.said)
        for _ in range(50):
            bench.feed.mavlink(0, "in", bytes(20), 1)
            await asyncio.sleep(0.01)
        assert bench.said == ["void: recording stopped, File too large"]
        await until(lambda: bench.recorder()["recording"] is False)
        assert len(bench.logged("recording_stopped")) == 1
        assert not bench.logged("io_died")
        bench.desk.record({"on": True})  # another file
        await until(lambda: bench.recorder()["recording"])
    finally:
        await bench.__aexit__()
    first = min(tmp_path.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    file = RecordingFile(first)
    found = [m for m in file.messages() if m.kind is Kind.FRAME]
    assert file.damage is not None
    assert len(found) >= 2
