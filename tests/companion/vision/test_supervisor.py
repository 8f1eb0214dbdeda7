"""The supervisor with real worker processes that run stub pipelines."""

import asyncio
import contextlib
import dataclasses
import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from companion.clock import RealClock
from companion.config import CameraConfig, DetectorConfig, LogConfig
from companion.errors import ConfigError, WorkerError
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport, Pose
from companion.log import open_log
from companion.vision.supervisor import VisionSupervisor
from tests.companion.vision.stub_pipelines import Echo

STUBS = "tests.companion.vision.stub_pipelines"
POSE = Pose(5, 1.0, 2.0, -3.0, (1.0, 0.0, 0.0, 0.0))
QUICK = DetectorConfig(deadline_s=20.0, restart_delay_s=0.02, restart_delay_max_s=0.5)


def grey(value: int, shape=(48, 64)) -> np.ndarray:
    return np.full(shape, value, np.uint8)


def alive(pid: int) -> bool:
    """Whether a process exists and has not ended (a zombie has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


async def until(holds, *, seconds: float = 30.0) -> None:
    for _ in range(round(seconds / 0.01)):
        if holds():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never came to hold")


class Bench:
    """A running supervisor, what it reported and what it logged."""

    def __init__(self, supervisor: VisionSupervisor, reports: list[DetectionReport], stream: io.StringIO):
        self.supervisor = supervisor
        self.reports = reports
        self._stream = stream
        self._seq = 0

    @property
    def status(self):
        return self.supervisor.status

    def events(self, name: str) -> list[dict]:
        records = [json.loads(line) for line in self._stream.getvalue().splitlines()]
        return [record for record in records if record["event"] == name]

    def offer(self, image, pose=None) -> Frame:
        frame = Frame(image, time.monotonic_ns(), self._seq)
        self._seq += 1
        self.supervisor.offer(frame, pose)
        return frame

    async def ready(self) -> None:
        await until(lambda: self.status.state == "ready")

    async def report_on(self, image, pose=None) -> DetectionReport:
        frame = self.offer(image, pose)
        await until(lambda: self.reports and self.reports[-1].frame_ns == frame.time_ns)
        return self.reports[-1]

    async def died(self, times: int = 1) -> None:
        await until(lambda: self.status.restarts + (self.status.state == "backoff") >= times)


@contextlib.asynccontextmanager
async def running(pipeline: str = "echo", detector: DetectorConfig = QUICK):
    reports: list[DetectionReport] = []
    stream = io.StringIO()
    with open_log(LogConfig(), stream) as log:
        supervisor = VisionSupervisor(
            detector,
            CameraConfig(),
            clock=RealClock(),
            on_report=reports.append,
            log=log,
            pipeline=f"{STUBS}:{pipeline}",
        )
        task = asyncio.create_task(supervisor.run())
        await asyncio.sleep(0)
        try:
            yield Bench(supervisor, reports, stream)
        finally:
            pid = supervisor.status.pid
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            assert pid is None or not alive(pid)
            assert supervisor.status.state == "stopped"


async def test_frames_become_reports_with_their_own_time_number_and_pose():
    async with running() as bench:
        assert bench.status.state == "starting"
        await bench.ready()
        rng = np.random.default_rng(3)
        for shape in ((48, 64), (30, 50), (120, 160), (48, 64), (1, 1)):  # smaller, larger, and back
            image = rng.integers(0, 200, shape, dtype=np.uint8)
            report = await bench.report_on(image, POSE)
            assert report.x_px == float(image.mean())
            assert report.y_px == float(image[[0, 0, -1, -1], [0, -1, 0, -1]].sum())
            assert report.pose == POSE
        assert [report.frame_seq for report in bench.reports] == list(range(5))
        assert bench.status.frames_offered == 5
        assert bench.status.frames_replaced == 0
        assert bench.status.last_report_ns >= bench.reports[-1].frame_ns
        assert alive(bench.status.pid)


async def test_a_pipeline_prepares_for_the_next_frame_after_each_report():
    async with running("counts") as bench:
        await bench.ready()
        assert [(await bench.report_on(grey(90))).x_px for _ in range(3)] == [0.0, 1.0, 2.0]


async def test_the_caller_may_reuse_its_image_at_once():
    async with running() as bench:
        await bench.ready()
        image = grey(Echo.SLOW)
        bench.offer(image)  # the worker is busy with this one
        image[:] = 7
        bench.offer(image)
        image[:] = 9
        await until(lambda: len(bench.reports) == 2)
        assert [report.x_px for report in bench.reports] == [float(Echo.SLOW), 7.0]


async def test_strided_images_are_copied_as_they_look():
    async with running() as bench:
        await bench.ready()
        wide = np.arange(48 * 128, dtype=np.int64).reshape(48, 128).astype(np.uint8) % 100
        report = await bench.report_on(wide[::2, ::2])
        assert report.x_px == float(wide[::2, ::2].mean())


async def test_a_pose_that_is_not_finite_is_no_pose():
    async with running() as bench:
        await bench.ready()
        for broken in ({"north_m": math.nan}, {"q_ned_from_body": (1.0, math.inf, 0.0, 0.0)}):
            report = await bench.report_on(grey(1), dataclasses.replace(POSE, **broken))
            assert report.pose is None
        assert bench.status.restarts == 0


async def test_the_newest_frame_wins_while_the_worker_is_busy():
    async with running() as bench:
        await bench.ready()
        bench.offer(grey(Echo.SLOW))
        assert bench.status.state == "busy"
        for value in range(10, 30):
            bench.offer(grey(value))
        await until(lambda: len(bench.reports) == 2)
        assert [report.x_px for report in bench.reports] == [float(Echo.SLOW), 29.0]
        assert bench.status.frames_offered == 21
        assert bench.status.frames_replaced == 19


async def test_the_newest_frame_offered_during_the_start_is_answered_first():
    async with running() as bench:
        for value in (1, 2, 3):
            bench.offer(grey(value))
        await until(lambda: bench.reports)
        assert bench.reports[0].x_px == 3.0
        assert bench.status.frames_replaced == 2


async def test_detection_resumes_by_itself_each_time_the_worker_is_killed():
    async with running() as bench:
        pids = set()
        for i in range(4):
            await bench.ready()
            pids.add(bench.status.pid)
            os.kill(bench.status.pid, signal.SIGKILL)
            await bench.died(i + 1)
            report = await bench.report_on(grey(i))
            assert report.x_px == float(i)
        assert len(pids) == 4
        assert bench.status.restarts == 4
        deaths = bench.events("worker_died")
        assert [death["status"] for death in deaths] == ["SIGKILL"] * 4
        assert [death["restart_delay_s"] for death in deaths[:3]] == [0.02, 0.04, 0.08]


async def test_an_answer_not_given_before_death_is_never_delivered():
    async with running() as bench:
        await bench.ready()
        lost = bench.offer(grey(Echo.SLOW))
        os.kill(bench.status.pid, signal.SIGKILL)
        await bench.died()
        await bench.report_on(grey(5))
        assert lost.time_ns not in {report.frame_ns for report in bench.reports}


@pytest.mark.parametrize("how", ["stopped", "hangs in C"])
async def test_a_worker_past_its_deadline_is_killed_and_its_late_answer_ignored(how: str):
    config = QUICK.model_copy(update={"deadline_s": 0.4})
    async with running(detector=config) as bench:
        await bench.ready()
        hung_pid = bench.status.pid
        if how == "stopped":
            os.kill(hung_pid, signal.SIGSTOP)
            late = bench.offer(grey(1))
        else:
            late = bench.offer(grey(Echo.HANG_IN_C))
        await bench.died()
        await until(lambda: not alive(hung_pid))
        assert bench.status.last_error == "no answer within 0.4 s"
        await bench.report_on(grey(2))
        assert late.time_ns not in {report.frame_ns for report in bench.reports}


async def test_a_worker_that_is_idle_has_no_deadline():
    config = QUICK.model_copy(update={"deadline_s": 0.2})
    async with running(detector=config) as bench:
        await bench.ready()
        await bench.report_on(grey(1))
        await asyncio.sleep(0.5)
        await bench.report_on(grey(2))
        assert bench.status.restarts == 0


async def test_a_worker_that_does_not_come_up_is_started_again():
    config = QUICK.model_copy(update={"start_timeout_s": 0.5})
    async with running("never_ready", config) as bench:
        await bench.died(2)
        assert bench.status.last_error == "not up within 0.5 s"


async def test_an_exception_in_the_pipeline_is_logged_with_its_traceback_and_ends_the_worker():
    async with running() as bench:
        await bench.ready()
        bench.offer(grey(Echo.CRASH))
        await bench.died()
        assert bench.status.last_error == "RuntimeError: asked to crash"
        await until(lambda: bench.events("worker_died"))
        (death,) = bench.events("worker_died")
        assert "stub_pipelines.py" in death["traceback"]
        assert death["status"] == "exit status 1"


async def test_a_crash_in_native_code_leaves_its_last_words_in_the_log():
    async with running() as bench:
        await bench.ready()
        bench.offer(grey(Echo.KILLED))
        await bench.died()
        await until(lambda: bench.events("worker_died"))
        (death,) = bench.events("worker_died")
        assert death["status"] == "SIGSEGV"
        assert "Segmentation fault" in "".join(line["line"] for line in bench.events("worker_output"))


async def test_a_worker_that_leaves_without_a_word_is_restarted():
    async with running() as bench:
        await bench.ready()
        bench.offer(grey(Echo.LEAVE))
        await bench.died()
        await until(lambda: bench.events("worker_died"))
        (death,) = bench.events("worker_died")
        assert (death["reason"], death["status"]) == ("ended by itself", "exit status 3")
        assert death["output"] == "I am off"


async def test_a_chatty_worker_neither_blocks_nor_floods_the_log():
    async with running() as bench:
        await bench.ready()
        await bench.report_on(grey(Echo.CHATTER))
        await bench.report_on(grey(1))
        await until(lambda: bench.events("worker_output"))  # it comes through a pipe of its own
        assert len(bench.events("worker_output")) <= 50


@pytest.mark.parametrize(
    ("pipeline", "reason"),
    [
        ("strange", "said what is no message"),
        ("mistaken", "said answer out of turn"),
        ("broken", "ZeroDivisionError: a fault of the program"),
    ],
)
async def test_what_is_no_answer_to_the_question_is_not_delivered(pipeline: str, reason: str):
    async with running(pipeline) as bench:
        bench.offer(grey(1))
        await bench.died()
        assert reason in bench.status.last_error
        assert bench.reports == []


async def test_a_configuration_that_the_first_worker_cannot_use_ends_run():
    with open_log(LogConfig(), io.StringIO()) as log:
        supervisor = VisionSupervisor(
            QUICK,
            CameraConfig(),
            clock=RealClock(),
            on_report=lambda _: None,
            log=log,
            pipeline=f"{STUBS}:unusable",
        )
        with pytest.raises(ConfigError, match="no such file"):
            await supervisor.run()
        assert supervisor.status.state == "stopped"


async def test_a_fault_in_on_report_ends_run_and_the_worker():
    def faulty(report):
        raise ZeroDivisionError

    with open_log(LogConfig(), io.StringIO()) as log:
        supervisor = VisionSupervisor(
            QUICK, CameraConfig(), clock=RealClock(), on_report=faulty, log=log, pipeline=f"{STUBS}:echo"
        )
        task = asyncio.create_task(supervisor.run())
        await until(lambda: supervisor.status.state == "ready")
        pid = supervisor.status.pid
        supervisor.offer(Frame(grey(1), 1, 1), None)
        with pytest.raises(ZeroDivisionError):
            await task
        assert not alive(pid)


async def test_cancelling_ends_a_busy_or_starting_worker_at_once():
    for busy in (True, False):
        async with running() as bench:
            if busy:
                await bench.ready()
                bench.offer(grey(Echo.HANG_IN_C))
            else:
                await until(lambda: bench.status.pid is not None)
        # The bench has cancelled it, and found its process gone.
        assert bench.events("worker_died") == []


async def test_an_interrupt_from_the_terminal_does_not_reach_the_worker():
    async with running() as bench:
        await bench.ready()
        assert os.getpgid(bench.status.pid) != os.getpgid(0)
        os.kill(bench.status.pid, signal.SIGINT)
        assert (await bench.report_on(grey(3))).x_px == 3.0
        assert bench.status.restarts == 0


async def test_the_event_loop_goes_on_while_workers_start_hang_and_die():
    config = QUICK.model_copy(update={"deadline_s": 0.3})
    ticks: Counter[str] = Counter()
    async with running(detector=config) as bench:

        async def tick():
            while True:
                ticks[bench.status.state] += 1
                await asyncio.sleep(0.005)

        ticking = asyncio.create_task(tick())
        await bench.ready()
        bench.offer(grey(Echo.HANG_IN_C))
        await bench.died()
        await bench.report_on(grey(1))
        ticking.cancel()
    # A start takes some tenths of a second and the hung worker held its core for 0.3 s: both went on beside us.
    assert ticks["starting"] > 5
    assert ticks["busy"] > 5


async def test_images_that_are_none_are_refused():
    async with running() as bench:
        for image in (np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4)), np.zeros((0, 4), np.uint8)):
            with pytest.raises(ValueError, match=r"expected \(H, W\) uint8"):
                bench.offer(image)


async def test_no_memory_for_a_frame_is_counted_and_survived(monkeypatch: pytest.MonkeyPatch):
    async with running() as bench:
        await bench.ready()

        def full(*_):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, "posix_fallocate", full)
            bench.offer(grey(1))
        assert bench.status.frames_refused == 1
        assert (await bench.report_on(grey(2))).x_px == 2.0
        assert len(bench.events("frame_refused")) == 1


async def test_no_process_to_be_had_is_retried_for_ever(monkeypatch: pytest.MonkeyPatch):
    def refuse(*_, **__):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    real = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", refuse)
    async with running() as bench:
        await bench.died(3)
        assert "cannot be started" in bench.status.last_error
        monkeypatch.setattr(subprocess, "Popen", real)
        assert (await bench.report_on(grey(2))).x_px == 2.0


async def validated(pipeline: str, **changes) -> None:
    with open_log(LogConfig(), io.StringIO()) as log:
        await VisionSupervisor(
            QUICK.model_copy(update=changes),
            CameraConfig(file="gone.toml"),
            clock=RealClock(),
            on_report=lambda report: None,
            log=log,
            pipeline=pipeline,
        ).validate()


async def test_validation_tells_a_bad_configuration_from_a_fault():
    await validated(f"{STUBS}:echo")
    with pytest.raises(ConfigError, match=r"gone\.toml: no such file"):
        await validated(f"{STUBS}:unusable")
    with pytest.raises(ConfigError, match="cannot be found"):
        await validated("no.such.module:thing")
    with pytest.raises(WorkerError, match="No module named 'not_installed'"):
        await validated("tests.companion.vision.stub_pipeline_without_its_library:echo")
    with pytest.raises(WorkerError, match="ZeroDivisionError: a fault of the program"):
        await validated(f"{STUBS}:broken")
    with pytest.raises(WorkerError, match=r"not up within 0\.2 s"):
        await validated(f"{STUBS}:never_ready", start_timeout_s=0.2)


PARENT = """
import asyncio, sys
import numpy as np
from companion.clock import RealClock
from companion.config import CameraConfig, DetectorConfig, LogConfig
from companion.frames.source import Frame
from companion.log import open_log
from companion.vision.supervisor import VisionSupervisor

async def main():
    with open_log(LogConfig()) as log:
        supervisor = VisionSupervisor(
            DetectorConfig(deadline_s=60.0), CameraConfig(), clock=RealClock(), on_report=print, log=log,
            pipeline="tests.companion.vision.stub_pipelines:echo",
        )
        running = asyncio.create_task(supervisor.run())
        while supervisor.status.state != "ready":
            await asyncio.sleep(0.01)
        supervisor.offer(Frame(np.full((48, 64), int(sys.argv[1]), np.uint8), 1, 1), None)
        print(supervisor.status.pid, flush=True)
        await running

asyncio.run(main())
"""


def shared_memory_of(pid: int) -> set[str]:
    """What of a process's memory is shared, by name; one without a name in the file system is "(deleted)"."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {" ".join(line.split()[5:]) for line in lines if "memfd:" in line or "/shm/" in line}


@pytest.mark.parametrize("doing", [0, Echo.HANG_IN_C, "stopped"], ids=["idle", "hanging in C", "stopped"])
def test_no_worker_and_no_shared_memory_outlives_a_killed_parent(doing):
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(0 if doing == "stopped" else doing)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        text=True,
    )
    try:
        lines = iter(parent.stdout.readline, "")
        pid = next(int(line) for line in lines if line.strip().isdigit())
        wait_for(lambda: shared_memory_of(pid))
        assert shared_memory_of(pid) == shared_memory_of(parent.pid) == {"/memfd:companion-frames (deleted)"}
        if doing == "stopped":
            os.kill(pid, signal.SIGSTOP)
        assert alive(pid)
    finally:
        parent.kill()
        parent.wait(10)
        parent.stdout.close()
    wait_for(lambda: not alive(pid))


def wait_for(holds) -> None:
    for _ in range(1000):
        if holds():
            return
        time.sleep(0.01)
    raise AssertionError("it never came to hold")
