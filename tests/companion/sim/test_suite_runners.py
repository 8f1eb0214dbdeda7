"""Flights of a suite in processes of their own, on this machine and on a cluster: none is lost, none is left behind."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest
from distributed import LocalCluster

from companion.sim.flight import FlightSpec
from companion.sim.suite import Ending, PlannedFlight, SuiteError, plan_flights, run_suite
from companion.sim.suite_process import FlightProcesses
from companion.sim.suite_runners import fly_locally, fly_on_cluster

FLIGHTS = plan_flights(["room"], [1, 2, 3], ["off"], FlightSpec())
RESULT = '{"result": {"outcome": "reached"}, "succeeded": true}'


def program(body: str) -> tuple[str, ...]:
    """Return a stand-in for the program that flies: ``folder`` is its folder, ``seed`` the flight's."""
    head = (
        "import json, os, pathlib, signal, subprocess, sys, time\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "seed = json.loads((folder / 'flight.json').read_text())['spec']['seed']\n"
        f"def finish(): (folder / 'result.json').write_text({RESULT!r})\n"
    )
    return (sys.executable, "-S", "-c", head + body)


def fly(body: str, *, time_limit_s: float = 60.0) -> Ending:
    return FlightProcesses(program(body), time_limit_s=time_limit_s).fly(FLIGHTS[0])


def is_gone(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for yet counts."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def wait_until_gone(pid: int) -> None:
    deadline = threading.Event()
    for _ in range(200):
        if is_gone(pid):
            return
        deadline.wait(0.05)
    raise AssertionError(f"process {pid} is still there")


# ---- one process


def test_what_a_flight_leaves_comes_back():
    ending = fly(
        "(folder / 'record.npz').write_bytes(b'r'); (folder / 'video.mp4').write_bytes(b'v'); finish()"
    )
    assert ending.result == {"outcome": "reached"}
    assert (ending.succeeded, ending.error, ending.record, ending.video) == (True, None, b"r", b"v")


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "the simulation was ended by SIGSEGV"),
        (
            "print('first'); raise RuntimeError('boom')",
            "the simulation failed: RuntimeError: boom (exit code 1)",
        ),
        ("sys.exit(3)", "the simulation failed: without a word (exit code 3)"),
        ("pass", "the simulation ended without a result"),
        ("(folder / 'result.json').write_text('{')", "the simulation ended without a result"),
        ("(folder / 'result.json').write_text('{\"error\": \"no such world\"}')", "no such world"),
    ],
)
def test_a_simulation_that_fails_says_why(body, error):
    ending = fly(body)
    assert (ending.result, ending.error) == (None, error)


@pytest.mark.parametrize("rest", ["os.abort()", "time.sleep(600)", "sys.exit(2)"])
def test_a_flight_that_was_flown_counts_even_when_its_video_fails(rest):
    body = f"(folder / 'record.npz').write_bytes(b'r'); (folder / 'video.mp4').write_bytes(b'half'); finish(); {rest}"
    ending = fly(body, time_limit_s=1.0)
    assert (ending.result, ending.record, ending.video) == ({"outcome": "reached"}, b"r", None)
    assert ending.error is not None


def test_the_log_of_a_failed_simulation_comes_back():
    assert "first" in fly("print('first', flush=True); raise RuntimeError('boom')").log


def test_a_simulation_that_hangs_is_ended():
    ending = fly("time.sleep(600)", time_limit_s=1.0)
    assert ending.error == "the simulation was ended after 1 s"


def test_a_program_that_is_not_there_is_a_failed_simulation():
    ending = FlightProcesses(("/nowhere/to/be/found",)).fly(FLIGHTS[0])
    assert ending.error is not None
    assert ending.error.startswith("the simulation could not be run: ")


def test_what_a_flight_has_started_ends_with_it(tmp_path):
    child = tmp_path / "child"
    ending = fly(
        "child = subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(600)'])\n"
        f"pathlib.Path({str(child)!r}).write_text(str(child.pid)); finish()"
    )
    assert ending.result is not None
    wait_until_gone(int(child.read_text()))


# ---- several on this machine


def test_a_crash_among_flights_is_recorded_and_the_others_fly(tmp_path):
    processes = FlightProcesses(program("os.abort() if seed == 2 else finish()"))
    finished = run_suite(FLIGHTS, tmp_path, lambda flights: fly_locally(flights, jobs=2, processes=processes))
    assert [flight.outcome for flight in finished] == ["reached", "failed simulation", "reached"]
    assert finished[1].error == "the simulation was ended by SIGABRT"


def test_closing_early_ends_what_flies_and_begins_nothing_more(tmp_path):
    body = f"(pathlib.Path({str(tmp_path)!r}) / str(seed)).write_text(str(os.getpid()))\n"
    body += "finish() if seed == 1 else time.sleep(600)"
    # One job: while flight 1 is looked at here, flight 2 begins; 3 waits.
    with closing(fly_locally(FLIGHTS, jobs=1, processes=FlightProcesses(program(body)))) as endings:
        flight, ending = next(endings)
        assert (flight, ending.error) == (FLIGHTS[0], None)
        for _ in range(200):
            if (tmp_path / "2").exists() and (tmp_path / "2").read_text():
                break
            threading.Event().wait(0.05)
    wait_until_gone(int((tmp_path / "2").read_text()))
    assert not (tmp_path / "3").exists()


def test_jobs_below_one_are_refused():
    with pytest.raises(SuiteError, match="jobs: found 0"):
        next(fly_locally(FLIGHTS, jobs=0, processes=FlightProcesses()))


# ---- a cluster


def far_away(flight: PlannedFlight) -> Ending:
    """Fly on a worker: a process that is told which flight and says where it was."""
    if flight.spec.seed == 2:
        raise ValueError("no such\nthing here")
    return Ending(result={"outcome": "reached"}, succeeded=True, log=str(os.getpid()))


def deadly(flight: PlannedFlight) -> Ending:
    """End the worker itself, as a machine that goes down would."""
    os._exit(1)


@pytest.fixture(scope="module")
def cluster():
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=None,
        worker_dashboard_address=None,
        silence_logs=50,
        scheduler_kwargs={"allowed_failures": 0},
    ) as two_workers:
        yield two_workers


def test_a_cluster_of_two_workers_flies_all_and_a_failure_is_one_of_them(cluster):
    scheduler = cluster.scheduler_address
    endings = dict(fly_on_cluster(FLIGHTS, scheduler=scheduler, fly=far_away))
    assert set(endings) == set(FLIGHTS)
    assert endings[FLIGHTS[1]].error == "the worker failed: ValueError: no such thing here"
    assert {int(endings[flight].log) for flight in (FLIGHTS[0], FLIGHTS[2])}.isdisjoint({os.getpid()})


def test_a_suite_flown_on_a_cluster_is_kept_like_any_other(cluster, tmp_path):
    def fly_all(flights):
        return fly_on_cluster(flights, scheduler=cluster.scheduler_address, fly=far_away)

    finished = run_suite(FLIGHTS, tmp_path, fly_all)
    assert [flight.outcome for flight in finished] == ["reached", "failed simulation", "reached"]


@pytest.mark.slow
def test_a_real_flight_on_a_worker_brings_its_record_back(cluster):
    wall = "{ from_m = [0, 0], to_m = [4, 0] }"
    text = (
        "name = 'hall'\nstart = { north_m = 2, east_m = 2 }\n"
        f"goal = {{ north_m = 4, east_m = 2 }}\nwalls = [{wall}]\n"
    )
    flight = PlannedFlight("hall", FlightSpec(world="hall.toml", method="off"), text)
    ((_, ending),) = fly_on_cluster([flight], scheduler=cluster.scheduler_address)
    assert ending.error is None, ending.log
    assert ending.succeeded
    assert ending.result["outcome"] == "reached"
    assert ending.record.startswith(b"PK")  # a zip, as npz is


def test_a_flight_whose_worker_goes_down_has_failed_and_the_cluster_flies_on(cluster):
    scheduler = cluster.scheduler_address
    ((_, ending),) = fly_on_cluster(FLIGHTS[:1], scheduler=scheduler, fly=deadly)
    assert ending.result is None
    assert ending.error.startswith("the worker failed: KilledWorker: ")
    ((_, ending),) = fly_on_cluster(FLIGHTS[:1], scheduler=scheduler, fly=far_away)
    assert ending.error is None


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    monkeypatch.setattr("companion.sim.suite_runners._CONNECT_S", 0.5)
    with pytest.raises(SuiteError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        next(fly_on_cluster(FLIGHTS, scheduler="tcp://127.0.0.1:9"))
