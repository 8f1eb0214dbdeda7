"""Metrics: what the official parser reads back from them, their names, and HTTP clients of every kind."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import re
import socket
import time

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_text
from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.status import http as http_module
from companion.status.http import MOST_CLIENTS, MetricsServer
from companion.status.metrics import encoder, families
from companion.status.show import duration, status_text

DEADLINE_S = 30.0
BASE_UNITS = ("seconds", "bytes", "celsius", "ratio")
OTHER_UNITS = re.compile(r"_(ms|milliseconds|minutes|mib|kib|mb|percent|deg|hz|kelvin)(_|$)")

STATUS = {
    "version": "0.1.0",
    "pid": 12,
    "uptime_s": 3725.0,
    "state": "HOLD",
    "reason": "no parallax",
    "not_ready": None,
    "frames_hz": 30.0,
    "reports_hz": 12.0,
    "setpoints_hz": 20.0,
    "pose_age_ms": 20,
    "pose": [1.0, 2.0, -1.2],
    "heading_deg": 90.0,
    "report": {"frame_seq": 7, "kind": "none", "reason": "too_few", "age_ms": 80, "detector_ms": 33},
    "engaged": True,
    "clock_round_trip_ms": 1.5,
    "armed": True,
    "autopilot_age_ms": 400,
    "source": {"url": "v4l2:/dev/video0", "fault": None, "frame_age_ms": 34},
    "worker": {
        "state": "busy",
        "pid": 13,
        "restarts": 2,
        "report_age_ms": 80,
        "frames_replaced": 5,
        "frames_refused": 0,
        "last_error": "ended by itself\ntraceback",
    },
    "links": {
        "link.planner": {
            "url": "udpin:0.0.0.0:14540",
            "state": "open",
            "peers": 1,
            "received_bytes": 1500,
            "received_frames": 20,
            "sent_bytes": 2_500_000,
            "crc_errors": 1,
            "sequence_gaps": 0,
            "drops": 0,
            "filtered": 0,
            "late_setpoints": 0,
            "opened": 1,
        }
    },
    "counts": {
        "frames": 900,
        "detections": {"none": 5, "void": 300},
        "reasons": {'with "quotes"\nand lines': 5},
        "forwarded": 1,
        "substituted": 2,
        "held": 3,
        "turned": 4,
        "dropped": {"not finite": 1},
        "unprotected": {},
        "rivalries": 0,
        "handler_errors": 0,
    },
    "host": {
        "uptime_s": 5000.0,
        "cpu_load": 0.25,
        "memory_used_mib": 400,
        "memory_total_mib": 1800,
        "disk_used_mib": None,
        "disk_total_mib": None,
        "temperatures_deg_c": {"cpu-thermal": 52.1},
    },
    "processes": {
        "service": {"pid": 12, "rss_mib": 80.0, "cpu_s": 3.5},
        "worker": {"pid": 13, "rss_mib": None, "cpu_s": None},
    },
}


def samples(text: str) -> dict[tuple, float]:
    return {
        (sample.name, *sample.labels.values()): sample.value
        for family in parse_text(text)
        for sample in family.samples
    }


def test_the_official_parser_reads_back_what_the_snapshot_says():
    body, content_type = encoder()(STATUS, "")
    assert content_type.startswith("text/plain")
    found = samples(body.decode())
    expected = {
        ("void_companion_build_info", "0.1.0"): 1,
        ("void_companion_uptime_seconds",): 3725,
        ("void_companion_state", "HOLD"): 1,
        ("void_companion_state", "FOLLOW"): 0,
        ("void_companion_ready",): 1,
        ("void_companion_frames_total",): 900,
        ("void_companion_frame_age_seconds",): 0.034,
        ("void_companion_report_age_seconds",): 0.08,
        ("void_companion_reports_without_direction_total", 'with "quotes"\nand lines'): 5,
        ("void_companion_setpoints_total", "held"): 3,
        ("void_companion_setpoints_dropped_total", "not finite"): 1,
        ("void_companion_worker_restarts_total",): 2,
        ("void_companion_link_up", "link.planner"): 1,
        ("void_companion_link_sent_bytes_total", "link.planner"): 2_500_000,
        ("void_companion_host_cpu_busy_ratio",): 0.25,
        ("void_companion_host_memory_used_bytes",): 400 * 1024 * 1024,
        ("void_companion_host_temperature_celsius", "cpu-thermal"): 52.1,
        ("void_companion_process_cpu_seconds_total", "service"): 3.5,
    }
    assert {key: found.get(key) for key in expected} == expected
    assert not any(key[0].startswith("void_companion_host_disk") for key in found)  # not known: left out
    assert ("void_companion_process_resident_memory_bytes", "worker") not in found


def test_openmetrics_is_given_to_who_asks_for_it():
    body, content_type = encoder()(STATUS, "application/openmetrics-text; version=1.0.0")
    assert content_type.startswith("application/openmetrics-text")
    assert len(list(parse_openmetrics(body.decode()))) > 20


def test_names_keep_the_conventions():
    for family in families(STATUS):
        assert re.fullmatch(r"void_companion_[a-z][a-z_]*[a-z]", family.name)
        assert family.documentation.endswith(".")
        assert not OTHER_UNITS.search(family.name), f"{family.name}: not a base unit"
        assert family.type in ("counter", "gauge", "info")
        if "_age" in family.name or "duration" in family.name or "uptime" in family.name:
            assert family.name.endswith(BASE_UNITS), family.name
    names = [family.name for family in families(STATUS)]
    assert len(names) == len(set(names))


def test_a_service_that_knows_nothing_yet_has_metrics_too():
    status = copy.deepcopy(STATUS)
    del status["report"], status["pose"], status["heading_deg"]
    status |= {"pose_age_ms": None, "autopilot_age_ms": None, "clock_round_trip_ms": None, "not_ready": "x"}
    status["source"] = {"url": "", "fault": "no frame yet", "frame_age_ms": None}
    status["counts"] |= {"detections": {}, "reasons": {}, "dropped": {}}
    found = samples(encoder()(status, "")[0].decode())
    assert (found[("void_companion_ready",)], found[("void_companion_source_up",)]) == (0, 0)
    assert ("void_companion_frame_age_seconds",) not in found


# ---------------------------------------------------------------- as text


def test_the_text_says_state_reason_rates_ages_links_worker_and_temperatures():
    text = status_text({**STATUS, "recorder": {"recording": True, "file": "", "bytes": 12}})
    for words in (
        "void-companion 0.1.0, up 1 h 2 min (pid 12)",
        "HOLD: no parallax; protection wanted; armed",
        "30.0/s, newest 34 ms old, v4l2:/dev/video0",
        "none (too_few), 80 ms old, took 33 ms",
        "north 1.0, east 2.0, down -1.2 m",
        "heartbeat 400 ms old, clock within 1.5 ms",
        "1 forwarded, 2 substituted, 3 held, 4 turned, 1 dropped, 0 unprotected",
        "busy (pid 13), 2 restarts, 5 frames replaced; last error: ended by itself",
        "in 1.5 kB, out 2.5 MB, 1 checksum errors",
        "load 25 %, memory 400 of 1800 MiB, cpu-thermal 52.1 C",
        "service 80.0 MiB, 3.5 s of processor, worker gone",
        "recorder   recording yes, bytes 12",
    ):
        assert words in text
    assert "traceback" not in text


def test_what_is_wrong_is_in_the_text():
    status = copy.deepcopy(STATUS)
    status |= {"engaged": False, "not_ready": "pose too old", "pose_age_ms": 65_000}
    status["source"]["fault"] = "no frames from the camera"
    text = status_text(status)
    for words in (
        "protection NOT wanted",
        "not ready: pose too old",
        "FAULT: no frames from the camera",
        "1 min 5 s old",
    ):
        assert words in text


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (185, "3 min 5 s"), (7980, "2 h 13 min"), (356_400, "4 d 3 h")]
)
def test_a_duration_in_words(seconds, words):
    assert duration(seconds) == words


# ---------------------------------------------------------------- over HTTP


class Bench:
    def __init__(self, port: int) -> None:
        captured = CapturingLogger()
        self.calls = captured.calls

        def as_call(logger, method, event):
            return (event.pop("event"),), event

        async def snapshot():
            return STATUS

        log = wrap_logger(captured, processors=[as_call]).bind()
        self.server = MetricsServer("127.0.0.1", port, snapshot=snapshot, log=log)

    def events(self, name: str) -> list[dict]:
        return [call.kwargs for call in self.calls if call.args == (name,)]

    async def until(self, name: str) -> dict:
        end_s = time.monotonic() + DEADLINE_S
        while not self.events(name):
            assert time.monotonic() < end_s, "did not come"
            await asyncio.sleep(0.01)
        return self.events(name)[0]


@contextlib.asynccontextmanager
async def serving(port: int = 0):
    bench = Bench(port)
    task = asyncio.create_task(bench.server.run())
    try:
        yield bench
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def get(port: int, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(request)
    try:
        return await asyncio.wait_for(reader.read(), DEADLINE_S)
    finally:
        writer.close()


async def test_a_scrape_is_answered_and_everything_else_is_refused():
    async with serving() as bench:
        port = (await bench.until("metrics_open"))["port"]
        answer = await get(port, b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 OK\r\n")
        assert f"Content-Length: {len(body)}".encode() in head
        assert samples(body.decode())[("void_companion_frames_total",)] == 900
        open_metrics = await get(
            port, b"GET /metrics HTTP/1.1\r\nAccept: application/openmetrics-text\r\n\r\n"
        )
        assert b"Content-Type: application/openmetrics-text" in open_metrics
        for request, status in (
            (b"GET / HTTP/1.1\r\n\r\n", b"404"),
            (b"POST /metrics HTTP/1.1\r\n\r\n", b"405"),
            (b"nonsense\r\n\r\n", b"400"),
            (b"HEAD /metrics HTTP/1.1\r\n\r\n", b"200"),
        ):
            answer = await get(port, request)
            assert answer.split()[1] == status
        assert answer.endswith(b"\r\n\r\n")  # HEAD: no body
        assert await get(port, b"GET /metrics HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n") == b""


async def test_one_client_too_many_is_turned_away(monkeypatch):
    monkeypatch.setattr(http_module, "_REQUEST_S", 2 * DEADLINE_S)
    async with serving() as bench:
        port = (await bench.until("metrics_open"))["port"]
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST_CLIENTS)]
        assert (await get(port, b"")).split()[1] == b"503"
        for _, writer in silent:
            writer.close()


async def test_clients_that_stall_are_hung_up_on(monkeypatch):
    monkeypatch.setattr(http_module, "_REQUEST_S", 0.1)
    async with serving() as bench:
        port = (await bench.until("metrics_open"))["port"]
        assert await get(port, b"GET /metrics HT") == b""
        monkeypatch.setattr(http_module, "_REQUEST_S", DEADLINE_S)
        assert (await get(port, b"GET /metrics HTTP/1.0\r\n\r\n")).split()[1] == b"200"


async def test_a_port_that_is_taken_is_announced_once_and_tried_again(monkeypatch):
    monkeypatch.setattr(http_module, "_RETRY_S", 0.01)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        async with serving(port) as bench:
            event = await bench.until("metrics_failed")
            assert "in use" in event["error"]
            await asyncio.sleep(0.1)
            assert len(bench.events("metrics_failed")) == 1
            taken.close()
            await bench.until("metrics_open")
            assert (await get(port, b"GET /metrics HTTP/1.1\r\n\r\n")).split()[1] == b"200"
