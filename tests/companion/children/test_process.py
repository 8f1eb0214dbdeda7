"""Child processes: output in lines, last words, an end in every case."""

import asyncio
import contextlib
import os
import signal
import time
from pathlib import Path

import pytest

from companion.children.output import OutputLines
from companion.children.process import ChildProcess, status_in_words

TALKER = "tests.fakes.talking_child"


async def closed(child: ChildProcess) -> None:
    """Wait until the process has closed its socket."""
    async with asyncio.timeout(30):
        while True:
            with contextlib.suppress(BlockingIOError):
                if not child.receive_packet(100):
                    return
            await asyncio.sleep(0.01)


def variables_of(pid: int) -> dict[str, str]:
    """Return the environment that a process was started with; the kernel has none of it in the first moment."""
    end_s = time.monotonic() + 30.0
    while not (text := Path(f"/proc/{pid}/environ").read_text()):
        assert time.monotonic() < end_s
        time.sleep(0.01)
    return dict(line.split("=", 1) for line in text.split("\0") if "=" in line)


async def test_its_first_lines_are_handed_on_and_its_last_words_kept():
    child = ChildProcess.start_module(TALKER, threads=1)
    got: list[str] = []
    lines = OutputLines(got.append)
    asyncio.get_running_loop().add_reader(child.output_fd, lambda: lines.read_from(child))
    try:
        child.send_packet(b"60 lines")
        await closed(child)
        async with asyncio.timeout(30):
            while "line 59" not in lines.last_words:  # noqa: ASYNC110  it crosses the kernel
                await asyncio.sleep(0.01)
    finally:
        asyncio.get_running_loop().remove_reader(child.output_fd)
        status = child.stop(10.0)
    assert status == 0
    assert got == ["x" * 1000, *(f"line {n}" for n in range(49))]
    assert lines.last_words.splitlines() == [f"line {n}" for n in range(50, 60)]


def test_it_has_variables_of_its_own_where_ours_does_not_set_them(monkeypatch):
    monkeypatch.setenv("VOID_TEST_SET", "ours")
    given = {"VOID_TEST_SET": "given", "VOID_TEST_NEW": "given", "OMP_NUM_THREADS": "7"}
    child = ChildProcess.start_module(TALKER, threads=1, environment=given)
    try:
        found = variables_of(child.pid)
    finally:
        child.stop()
    assert (found["VOID_TEST_SET"], found["VOID_TEST_NEW"]) == ("ours", "given")
    assert found["OMP_NUM_THREADS"] == "1"
    assert "VOID_TEST_NEW" not in os.environ


@pytest.mark.parametrize("grace_s", [0.0, 0.2])
def test_one_that_does_not_end_is_killed(grace_s):
    child = ChildProcess.start_module(TALKER, threads=1)
    child.send_packet(b"stay")
    assert child.stop(grace_s) == -signal.SIGKILL
    with pytest.raises(ProcessLookupError):
        os.kill(child.pid, 0)


def test_statuses_in_words():
    assert status_in_words(None) == "still there after SIGKILL"
    assert status_in_words(3) == "exit status 3"
    assert status_in_words(-signal.SIGSEGV) == "SIGSEGV"
    assert status_in_words(-99) == "signal 99"
