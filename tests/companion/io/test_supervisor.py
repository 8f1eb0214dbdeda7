"""The I/O process: fed and answered, started again after its death, and never waited for."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.config import Config
from companion.frames.source import Frame
from companion.io.feed import Feed
from companion.io.messages import Answer, Kind
from companion.io.supervisor import IoSupervisor

DEADLINE_S = 60.0
STUBS = "tests.companion.io.stub_sinks"


async def until(condition):
    end_s = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert time.monotonic() < end_s, "did not come"
        await asyncio.sleep(0.01)
    return found


async def double(fields):
    return Answer(accepted=True, fields={"value": 2 * fields["value"]})


class Bench:
    """A feed, its supervisor, and what the sinks have written."""

    def __init__(self, folder: Path, *sinks: str) -> None:
        self.folder = folder
        captured = CapturingLogger()

        def as_call(logger, method, event):
            return (event.pop("event"),), event

        log = wrap_logger(captured, processors=[as_call]).bind()
        self.calls = captured.calls
        self.feed = Feed()
        config = Config.model_validate({"recorder": {"folder": str(folder)}})
        self.io = IoSupervisor(
            self.feed,
            [f"{STUBS}:{sink}" for sink in sinks],
            config,
            handlers={"double": double},
            now_ns=time.monotonic_ns,
            log=log,
        )
        self.feed.config(config, 1)

    async def __aenter__(self):
        self.task = asyncio.create_task(self.io.run())
        return self

    async def __aexit__(self, *_):
        self.task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self.task
        self.feed.close()

    def logged(self, event: str):
        return [call.kwargs for call in self.calls if call.args == (event,)]

    def seen(self, did: str | None = None, file: str = "seen.jsonl"):
        path = self.folder / file
        lines = path.read_text().split("\n")[:-1] if path.exists() else []  # the last one may not be whole
        found = [json.loads(line) for line in lines]
        return [line for line in found if did is None or line.get("did") == did]

    def taken(self, kind: Kind):
        return [line for line in self.seen("take") if line["kind"] == kind]

    async def listening(self):
        await until(lambda: self.feed.wants(Kind.FRAME))


async def test_a_sink_is_told_in_order_and_its_requests_are_answered(tmp_path):
    async with Bench(tmp_path, "writing") as bench:
        await bench.listening()
        for number in range(500):
            bench.feed.mavlink(0, "in", number.to_bytes(2, "big"), number)
        bench.feed.frame(Frame(np.full((480, 640), 3, np.uint8), 5, 0), 6)
        bench.feed.control("ask", {}, 7)
        bench.feed.control("say", {}, 8)
        await until(lambda: bench.seen("refused") and bench.logged("sink_says") and bench.logged("io_output"))
    assert [line["data"] for line in bench.taken(Kind.MAVLINK)] == [f"{n:04x}" for n in range(500)]
    (frame,) = bench.taken(Kind.FRAME)
    assert (frame["sum"], frame["shape"]) == (3 * 480 * 640, [480, 640])
    assert bench.taken(Kind.CONFIG)  # what held before it listened
    assert bench.seen("answered") == [{"did": "answered", "accepted": True, "value": 42}]
    assert bench.seen("refused")[0]["reasons"] == ["nobody here does 'nothing'"]
    assert bench.logged("sink_says") == [{"text": "hello"}]
    assert "printed by a sink" in {line["line"] for line in bench.logged("io_output")}
    assert bench.seen()[-1] == {"did": "stop"}
    assert bench.feed.dropped == {}


async def test_a_dead_process_is_started_again_and_told_anew(tmp_path):
    async with Bench(tmp_path, "writing") as bench:
        await bench.listening()
        first = bench.io.pid
        os.kill(first, signal.SIGKILL)
        await until(lambda: bench.logged("io_died"))
        assert not bench.feed.wants(Kind.FRAME) or bench.io.pid != first
        await until(lambda: bench.io.restarts == 1 and bench.io.pid not in (None, first))
        await bench.listening()
        bench.feed.state("a", "b", "after its death", 1)
        bench.feed.frame(Frame(np.full((48, 64), 1, np.uint8), 5, 0), 6)
        await until(lambda: bench.taken(Kind.STATE) and bench.taken(Kind.FRAME))
    assert len(bench.seen("start")) == 2
    assert bench.logged("io_died")[0]["status"] == "SIGKILL"


async def test_a_sink_that_exits_or_fails_is_said(tmp_path):
    async with Bench(tmp_path, "writing") as bench:
        await bench.listening()
        bench.feed.control("fail", {}, 1)
        (failed,) = await until(lambda: bench.logged("sink_failed"))
        assert "a fault of this sink" in failed["error"]
        await until(lambda: not bench.feed.wants(Kind.FRAME))  # it wants nothing any more
        assert bench.logged("io_died") == []


async def test_a_slow_sink_is_slow_for_itself_alone_and_the_end_is_in_time(tmp_path):
    async with Bench(tmp_path, "slow", "writing") as bench:
        await bench.listening()
        await until(lambda: bench.seen(file="slow.jsonl"))
        for number in range(20_000):
            bench.feed.mavlink(0, "in", number.to_bytes(2, "big"), number)
            if number % 1000 == 0:
                await asyncio.sleep(0.02)
        bench.feed.state("a", "b", "last", 1)
        await until(lambda: bench.taken(Kind.STATE))
        assert len(bench.taken(Kind.MAVLINK)) > 3000
        await until(lambda: bench.seen(file="slow.jsonl")[-1]["dropped"] > 0)
        pid = bench.io.pid
    assert {"did": "stop"} in bench.seen()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


async def test_a_stalled_process_costs_nothing_but_its_messages(tmp_path):
    async with Bench(tmp_path, "writing") as bench:
        await bench.listening()
        os.kill(bench.io.pid, signal.SIGSTOP)
        for number in range(20):
            for _ in range(1000):
                bench.feed.mavlink(0, "in", bytes(280), number)
            await asyncio.sleep(0.02)
        assert bench.feed.dropped["mavlink"] > 0
        os.kill(bench.io.pid, signal.SIGCONT)
        bench.feed.state("a", "b", "awake", 1)
        await until(lambda: bench.taken(Kind.STATE))


async def test_a_configuration_that_no_sink_can_use_is_said_once(tmp_path):
    async with Bench(tmp_path, "unusable") as bench:
        (said,) = await until(lambda: bench.logged("io_unusable"))
        assert said["error"].startswith("recorder.folder: found")
        await asyncio.wait_for(asyncio.shield(bench.task), DEADLINE_S)  # over, and the flight goes on without
        assert bench.io.restarts == 0


async def test_ending_while_it_starts_leaves_no_process(tmp_path):
    async with Bench(tmp_path, "hanging") as bench:
        pid = await until(lambda: bench.io.pid)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
