"""What the status says of the computer and of our processes, and that a part that fails hides no other."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.clock import RealClock
from companion.status.machine import Machine, process_use, temperatures_deg_c
from companion.status.snapshot import Snapshots


def zone(root: Path, number: int, name: str, millidegrees: str) -> None:
    folder = root / f"sys/class/thermal/thermal_zone{number}"
    folder.mkdir(parents=True)
    (folder / "type").write_text(f"{name}\n")
    (folder / "temp").write_text(millidegrees)


def test_temperatures_have_the_kernels_names_and_what_is_off_is_left_out(tmp_path):
    for number, (name, millidegrees) in enumerate(
        [
            ("cpu-thermal", "52123\n"),
            ("gpu", "-274000"),
            ("cpu-thermal", "48000"),
            ("", "30000"),
            ("x", "off"),
        ]
    ):
        zone(tmp_path, number, name, millidegrees)
    assert temperatures_deg_c(tmp_path) == {"cpu-thermal": 52.1, "thermal_zone2": 48.0, "thermal_zone3": 30.0}
    assert temperatures_deg_c(tmp_path / "none") == {}


def test_the_use_of_a_process_is_read_also_where_its_name_has_brackets(tmp_path):
    folder = tmp_path / "proc/7"
    folder.mkdir(parents=True)
    (folder / "statm").write_text("5000 256 100 1 0 200 0\n")
    fields = ["S", *["0"] * 10, "150", "50", *["0"] * 20]
    (folder / "stat").write_text(f"7 (a) b (c) {' '.join(fields)}\n")
    use = process_use(7, tmp_path)
    assert use["rss_mib"] == round(256 * os.sysconf("SC_PAGE_SIZE") / (1 << 20), 1)
    assert use["cpu_s"] == 200 / os.sysconf("SC_CLK_TCK")
    assert process_use(8, tmp_path) == {"rss_mib": None, "cpu_s": None}
    own = process_use(os.getpid())
    assert own["rss_mib"] > 1
    assert own["cpu_s"] > 0


class StandingClock(RealClock):
    def __init__(self) -> None:
        self.at_ns = 10**12

    def now_ns(self) -> int:
        return self.at_ns


async def test_the_machine_is_looked_at_at_most_twice_a_second(tmp_path):
    clock = StandingClock()
    machine = Machine(tmp_path, clock=clock, root=tmp_path)
    zone(tmp_path, 0, "cpu", "50000")
    processes = {"service": os.getpid(), "worker": None}
    first = await machine.look(processes)
    assert first["host"]["temperatures_deg_c"] == {"cpu": 50.0}
    assert first["host"]["disk_total_mib"] > 0
    assert first["processes"].keys() == {"service"}
    (tmp_path / "sys/class/thermal/thermal_zone0/temp").write_text("60000")
    clock.at_ns += 400_000_000
    assert (await machine.look(processes))["host"]["temperatures_deg_c"] == {"cpu": 50.0}
    clock.at_ns += 200_000_000
    assert (await machine.look(processes))["host"]["temperatures_deg_c"] == {"cpu": 60.0}


async def test_a_part_that_fails_is_left_out_and_said_once(tmp_path):
    captured, clock = CapturingLogger(), StandingClock()
    log = wrap_logger(captured, processors=[lambda _, __, event: ((event.pop("event"),), event)]).bind()
    worker = SimpleNamespace(
        state="ready",
        pid=None,
        restarts=0,
        last_report_ns=clock.at_ns - 5_000_000,
        frames_replaced=0,
        frames_refused=0,
        last_error="",
    )
    statistics = SimpleNamespace(frames_total=3, detections={"none": 1}, reasons={})

    def fail(now_ns: int) -> dict:
        raise RuntimeError("a fault of the recorder's")

    snapshots = Snapshots(
        flight=SimpleNamespace(
            status=lambda now_ns: {"state": "HOLD"},
            armed=False,
            autopilot_age_ms=lambda now_ns: None,
            statistics=statistics,
        ),
        own=SimpleNamespace(status=lambda now_ns: {"engaged": True}),
        proxy=SimpleNamespace(counters=SimpleNamespace(as_dict=lambda: {"forwarded": 2})),
        vision=SimpleNamespace(status=worker),
        links=(),
        source=lambda: ("v4l2:/dev/video0", None, clock.at_ns - 34_000_000),
        machine=Machine(tmp_path, clock=clock, root=tmp_path),
        processes=dict,
        sections={"recorder": fail, "other": lambda now_ns: {"on": True}},
        clock=clock,
        log=log,
    )
    for _ in range(3):
        status = await snapshots.take()
    assert (status["state"], status["engaged"], status["counts"]["forwarded"]) == ("HOLD", True, 2)
    assert status["source"]["frame_age_ms"] == 34
    assert status["worker"]["report_age_ms"] == 5
    assert status["other"] == {"on": True}
    assert "recorder" not in status
    assert [call.args for call in captured.calls] == [("status_section_failed",)]
