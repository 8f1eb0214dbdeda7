import asyncio
import io
import itertools
import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.clock import RealClock
from companion.config import LogConfig, SourceConfig
from companion.errors import SourceError
from companion.frames.file import FileSource
from companion.frames.open import open_source
from companion.log import open_log

MS = 1_000_000


class SteppedClock:
    """Time that passes only while somebody sleeps, or by hand."""

    def __init__(self) -> None:
        self.time_ns = 5_000 * MS

    def now_ns(self) -> int:
        return self.time_ns

    async def sleep_until_ns(self, when_ns: int) -> None:
        await asyncio.sleep(0)
        self.time_ns = max(self.time_ns, when_ns)


async def until(holds) -> None:
    """Wait for what another thread does."""
    for _ in range(2000):
        if holds():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never came to hold")


@pytest.fixture
def events():
    """Collects log events; `events()` after use gives their names."""
    stream = io.StringIO()
    with open_log(LogConfig(), stream) as log:
        yield log, lambda: [json.loads(line)["event"] for line in stream.getvalue().splitlines()]


@pytest.fixture
def log():
    with open_log(LogConfig(), io.StringIO()) as opened:
        yield opened


def folder_of(path: Path, count: int) -> Path:
    for i in range(count):
        cv2.imwrite(str(path / f"{i}.png"), np.full((24, 32), i, np.uint8))
    return path


async def all_frames(source: FileSource):
    async with source:
        return [frame async for frame in source.frames()]


async def test_frames_are_due_at_the_recorded_times(tmp_path: Path, log):
    clock = SteppedClock()
    source = FileSource(folder_of(tmp_path, 4), clock=clock, log=log, fps_hz=10)
    assert source.started_ns is None
    frames = await all_frames(source)
    assert source.started_ns == 5_000 * MS
    assert [frame.time_ns - source.started_ns for frame in frames] == [0, 100 * MS, 200 * MS, 300 * MS]
    assert [frame.seq for frame in frames] == [0, 1, 2, 3]
    assert [int(frame.image[0, 0]) for frame in frames] == [0, 1, 2, 3]
    assert source.counts.delivered == 4


async def test_no_frame_comes_before_it_is_due_in_real_time(tmp_path: Path, log):
    source = FileSource(folder_of(tmp_path, 4), clock=RealClock(), log=log, fps_hz=50)
    async with source:
        async for frame in source.frames():
            assert time.monotonic_ns() >= frame.time_ns


async def test_a_late_consumer_gets_the_newest_frame_and_no_backlog(tmp_path: Path, log):
    clock = SteppedClock()
    source = FileSource(folder_of(tmp_path, 20), clock=clock, log=log, fps_hz=10)
    met = []
    async with source:
        async for frame in source.frames():
            met.append(frame.seq)
            assert clock.time_ns - frame.time_ns < 100 * MS
            if frame.seq == 2:
                clock.time_ns += 1_050 * MS  # away for ten frames
    assert met == [0, 1, 2, *range(12, 20)]
    assert source.counts.skipped_late == 9
    assert source.counts.delivered + source.counts.skipped_late == 20


async def test_decoding_slower_than_the_recording_still_delivers(tmp_path: Path, log):
    class Slow(SteppedClock):
        def now_ns(self) -> int:
            self.time_ns += 150 * MS  # time runs off at every look
            return self.time_ns

    source = FileSource(folder_of(tmp_path, 40), clock=Slow(), log=log, fps_hz=10)
    frames = await all_frames(source)
    assert len(frames) >= 3
    assert all(a.time_ns < b.time_ns for a, b in itertools.pairwise(frames))


async def test_as_fast_as_possible_delivers_every_frame_without_waiting(tmp_path: Path, log):
    clock = SteppedClock()
    source = FileSource(folder_of(tmp_path, 10), clock=clock, log=log, fps_hz=1, fastest=True)
    frames = await all_frames(source)
    assert [frame.seq for frame in frames] == list(range(10))
    assert clock.time_ns == 5_000 * MS


async def test_a_loop_goes_on_with_increasing_times_and_numbers(tmp_path: Path, log):
    source = FileSource(folder_of(tmp_path, 3), clock=SteppedClock(), log=log, fps_hz=10, loop=True)
    frames = []
    async with source:
        async for frame in source.frames():
            frames.append(frame)
            if len(frames) == 8:
                break
    assert [frame.seq for frame in frames] == list(range(8))
    assert [int(frame.image[0, 0]) for frame in frames] == [0, 1, 2, 0, 1, 2, 0, 1]
    assert [(frame.time_ns - frames[0].time_ns) // MS for frame in frames] == [100 * i for i in range(8)]


async def test_whole_rounds_of_a_loop_are_passed_over_at_once(tmp_path: Path, log):
    clock = SteppedClock()
    source = FileSource(folder_of(tmp_path, 3), clock=clock, log=log, fps_hz=10, loop=True)
    async with source:
        frames = source.frames()
        await anext(frames)
        clock.time_ns += 1_000_000 * 100 * MS + 50 * MS  # a day or so
        met = [await anext(frames), await anext(frames)]
    assert all(frame.seq == (frame.time_ns - source.started_ns) // (100 * MS) for frame in met)
    assert all(int(frame.image[0, 0]) == frame.seq % 3 for frame in met)
    assert met[-1].seq >= 1_000_000


async def test_bad_images_are_counted_and_numbered(tmp_path: Path, events):
    log, names = events
    folder_of(tmp_path, 5)
    (tmp_path / "1.png").write_bytes(b"no image")
    cv2.imwrite(str(tmp_path / "3.png"), np.zeros((48, 64), np.uint8))
    source = FileSource(tmp_path, clock=SteppedClock(), log=log, fps_hz=10)
    frames = await all_frames(source)
    assert [frame.seq for frame in frames] == [0, 2, 4]
    assert (source.counts.undecodable, source.counts.wrong_size) == (1, 1)
    await asyncio.sleep(0.1)
    assert names() == ["image_undecodable", "image_size_changed"]


@pytest.mark.parametrize("loop", [False, True])
async def test_nothing_decodable_is_an_error_even_when_looped(tmp_path: Path, log, loop: bool):
    (tmp_path / "1.png").write_bytes(b"no image")
    with pytest.raises(SourceError, match="not one image"):
        await all_frames(FileSource(tmp_path, clock=SteppedClock(), log=log, loop=loop))


async def test_images_that_go_away_under_a_loop_end_it(tmp_path: Path, log):
    folder_of(tmp_path, 3)
    source = FileSource(tmp_path, clock=SteppedClock(), log=log, loop=True)
    async with source:
        frames = source.frames()
        await anext(frames)
        for i in range(3):
            (tmp_path / f"{i}.png").unlink()
        rest = [frame async for frame in frames]
    assert len(rest) <= 2


async def test_opening_what_is_not_there_is_a_clear_error(tmp_path: Path, log):
    with pytest.raises(SourceError, match="no such file"):
        async with open_source(SourceConfig(url=f"file:{tmp_path}/gone.mp4"), clock=RealClock(), log=log):
            pass
    with pytest.raises(SourceError, match=r"source\.url is empty"):
        open_source(SourceConfig(), clock=RealClock(), log=log)


async def test_the_configuration_chooses_how_it_plays(tmp_path: Path, log):
    config = SourceConfig(url=f"file:{folder_of(tmp_path, 3)}", playback="fastest", fps=1)
    async with open_source(config, clock=RealClock(), log=log) as source:
        assert [frame.seq async for frame in source.frames()] == [0, 1, 2]


async def test_cancelling_a_waiting_consumer_closes_cleanly(tmp_path: Path, log):
    source = FileSource(folder_of(tmp_path, 3), clock=RealClock(), log=log, fps_hz=0.1)

    async def consume():
        async with source:
            async for _ in source.frames():
                pass

    task = asyncio.create_task(consume())
    await until(lambda: source.counts.delivered)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
