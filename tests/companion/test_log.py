import datetime
import io
import json
import logging
import os
import pty
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from companion.config import LogConfig
from companion.log import LineWriter, descriptor_sink, open_log, wants_json


def logged(config: LogConfig, write) -> list[str]:
    stream = io.StringIO()
    with open_log(config, stream) as log:
        write(log)
    return stream.getvalue().splitlines()


def test_json_has_event_level_time_and_fields():
    (line,) = logged(LogConfig(), lambda log: log.info("worker_ready", pid=12, rate_hz=2.5))
    record = json.loads(line)
    assert list(record)[:3] == ["event", "level", "time"]
    stamp = datetime.datetime.fromisoformat(record.pop("time"))
    assert stamp.utcoffset() == datetime.timedelta(0)
    assert record == {"event": "worker_ready", "level": "info", "pid": 12, "rate_hz": 2.5}


def test_bound_fields_are_on_every_line():
    lines = logged(LogConfig(), lambda log: log.bind(loop="vision").warning("late"))
    assert json.loads(lines[0])["loop"] == "vision"


def test_the_level_is_a_floor():
    def write(log):
        for level in ("debug", "info", "warning", "error"):
            getattr(log, level)("x")

    levels = [json.loads(line)["level"] for line in logged(LogConfig(level="warning"), write)]
    assert levels == ["warning", "error"]


@pytest.mark.parametrize(
    ("value", "found"),
    [
        (float("nan"), "nan"),
        (float("-inf"), "-inf"),
        (np.float64(1.5), 1.5),
        (np.int32(3), 3),
        (np.bool_(True), True),
        ({1: (2.0, float("inf"))}, {"1": [2.0, "inf"]}),
        (Path("a"), repr(Path("a"))),
        ("two\nlines", "two\nlines"),
        ("\udc80", "\udc80"),
    ],
)
def test_any_value_is_one_line_of_valid_json(value, found):
    (line,) = logged(LogConfig(), lambda log: log.info("x", value=value))
    assert json.loads(line, parse_constant=pytest.fail)["value"] == found


def test_a_value_that_contains_itself_ends():
    loop: list[object] = []
    loop.append(loop)
    (line,) = logged(LogConfig(), lambda log: log.info("x", value=loop))
    assert json.loads(line)["event"] == "x"


def test_an_exception_is_in_the_line():
    def write(log):
        try:
            1 / 0  # noqa: B018  the error is what is wanted
        except ZeroDivisionError:
            log.exception("failed")

    (line,) = logged(LogConfig(), write)
    assert "ZeroDivisionError" in json.loads(line)["exception"]


def test_text_is_for_people():
    (line,) = logged(LogConfig(format="text"), lambda log: log.info("worker_ready", pid=12))
    assert "worker_ready" in line
    assert "pid=12" in line
    with pytest.raises(json.JSONDecodeError):
        json.loads(line)


def test_auto_is_text_on_a_terminal_only(tmp_path: Path):
    primary, secondary = pty.openpty()
    with os.fdopen(secondary, "w") as terminal, (tmp_path / "log").open("w") as file:
        assert not wants_json(LogConfig(), terminal)
        assert wants_json(LogConfig(format="json"), terminal)
        assert wants_json(LogConfig(), file)
        assert not wants_json(LogConfig(format="text"), file)
    assert wants_json(LogConfig(), None)
    os.close(primary)


def test_the_journal_is_told_each_lines_priority_and_nobody_else_is(tmp_path: Path, monkeypatch):
    for is_journal in (True, False):
        path = tmp_path / str(is_journal)
        with path.open("w") as stream:
            about = os.fstat(stream.fileno())
            inode = about.st_ino if is_journal else about.st_ino + 1
            monkeypatch.setenv("JOURNAL_STREAM", f"{about.st_dev}:{inode}")
            with open_log(LogConfig(level="debug"), stream) as log:
                for level in ("debug", "info", "warning", "error", "critical"):
                    getattr(log, level)("x")
        lines = path.read_text().splitlines()
        marks = [f"<{priority}>" for priority in (7, 6, 4, 3, 2)] if is_journal else [""] * 5
        assert [line[: line.index("{")] for line in lines] == marks
        assert [json.loads(line[line.index("{") :])["event"] for line in lines] == ["x"] * 5


def test_other_libraries_warnings_take_the_same_way():
    def write(log):
        logging.getLogger("mavsdk").warning("lost %d", 3)
        logging.getLogger("mavsdk").info("not asked for")

    (line,) = logged(LogConfig(), write)
    record = json.loads(line)
    assert (record["event"], record["logger"], record["message"]) == ("library_message", "mavsdk", "lost 3")
    assert record["level"] == "warning"


def test_a_stalled_sink_never_blocks_the_caller_and_the_loss_is_announced():
    entered, stalled, written = threading.Event(), threading.Event(), []

    def sink(data: bytes) -> None:
        entered.set()
        assert stalled.wait(60)
        written.append(data.decode().rstrip())

    writer = LineWriter(sink, lambda lines: f"dropped {lines}", capacity=10)
    writer.write("0")
    assert entered.wait(60)
    for i in range(1, 1000):  # returns although nothing can be written yet
        writer.write(str(i))
    assert writer.dropped >= 1000 - 11
    stalled.set()
    writer.close(30)
    (announced,) = [line for line in written if line.startswith("dropped")]
    kept = [line for line in written if not line.startswith("dropped")]
    assert kept == [str(i) for i in range(len(kept))]
    assert len(kept) + int(announced.split()[1]) == 1000


def test_closing_does_not_wait_for_ever_for_a_stalled_sink():
    stalled = threading.Event()
    writer = LineWriter(lambda _data: stalled.wait(30) and None, str, capacity=2)
    for i in range(10):
        writer.write(str(i))
    writer.close(0.05)
    stalled.set()


def test_a_full_pipe_is_written_on_when_it_drains():
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    data = bytes(range(256)) * 2000
    thread = threading.Thread(target=descriptor_sink(writing), args=(data,))
    thread.start()
    time.sleep(0.05)
    found = b""
    while len(found) < len(data):
        found += os.read(reading, 1 << 16)
    thread.join(10)
    assert found == data
    os.close(reading)
    os.close(writing)


def test_a_sink_that_breaks_loses_lines_and_nothing_else():
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream, open_log(LogConfig(), stream) as log:
        log.error("nobody_reads_this")


@pytest.mark.parametrize("redirection", ["2>&-", "2>/dev/full"])
def test_a_closed_or_full_standard_error_does_not_stop_the_program(redirection: str):
    program = (
        "from companion.config import LogConfig\nfrom companion.log import open_log\n"
        "with open_log(LogConfig()) as log:\n  log.info('x')\nprint('still here')"
    )
    done = subprocess.run(
        ["/bin/sh", "-c", f'exec "$0" -c "$1" {redirection}', sys.executable, program],
        stdout=subprocess.PIPE,
        timeout=60,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "still here\n")


def test_standard_error_is_the_default_and_is_flushed_at_exit():
    program = (
        "from companion.config import LogConfig\nfrom companion.log import open_log\n"
        "with open_log(LogConfig()) as log:\n  [log.info('x', i=i) for i in range(500)]"
    )
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, timeout=60, text=True)
    assert [json.loads(line)["i"] for line in done.stderr.splitlines()] == list(range(500))
