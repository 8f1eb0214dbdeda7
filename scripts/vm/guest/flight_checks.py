"""The camera goes and comes back while `companion run` flies the fake autopilot."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import vivid
from programs import PYTHON
from report import RESULTS, CheckFailedError, check, require

_HERE = Path(__file__).parent
_START_S = 2000.0
_LOST_S = 200.0
_BACK_S = 300.0


def run_all() -> None:
    """Make all checks of this module; vivid is loaded."""
    with _flight() as flight:
        if not check("flight: OFFBOARD with a live camera", lambda: _flying(flight)):
            return
        check(
            "flight: camera unbound and bound again", lambda: _gone_and_back(flight, vivid.unbind, vivid.bind)
        )
        check("flight: driver removed and loaded again", lambda: _gone_and_back(flight, _remove, vivid.load))
        check("flight: MAVLink untouched throughout", lambda: _end(flight))
    vivid.unload()  # whatever became of these checks, the next ones begin with a camera
    vivid.load()


class _Flight:
    """The flight probe's process, and what it has said."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._log = (RESULTS / "flight.jsonl").open("a")
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self._log.write(line)
            self._log.flush()
            self._lines.put(line)
        self._lines.put("")

    def wait_for(
        self, wanted: Callable[[dict[str, object]], bool], limit_s: float, what: str
    ) -> dict[str, object]:
        """Return the first thing it says from now on that is wanted."""
        end_s = time.monotonic() + limit_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, end_s - time.monotonic()))
            except queue.Empty:
                raise CheckFailedError(f"{what}: not within {limit_s:.0f} s") from None
            if not line:
                raise CheckFailedError(f"{what}: the flight has ended, code {self._process.wait()}")
            said = json.loads(line)
            if said["phase"] == "failed":
                raise CheckFailedError(f"{what}: {said['error']}")
            if wanted(said):
                return said

    def end(self) -> None:
        """Tell it to land."""
        self._process.stdin.write("\n")
        self._process.stdin.flush()


@contextmanager
def _flight() -> Iterator[_Flight]:
    words = [PYTHON, str(_HERE / "flight_probe.py"), str(vivid.node())]
    with (RESULTS / "flight.stderr").open("w") as errors:
        process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
        )
        try:
            yield _Flight(process)
        finally:
            process.kill()
            process.wait()


def _event(name: str) -> Callable[[dict[str, object]], bool]:
    return lambda said: said.get("event") == name


def _flying(flight: _Flight) -> str:
    said = flight.wait_for(lambda said: said["phase"] == "flying", _START_S, "OFFBOARD")
    return f"companion run is process {said['pid']}"


def _gone_and_back(flight: _Flight, remove: Callable[[], None], restore: Callable[[], None]) -> str:
    before = vivid.nodes()
    started_s = time.monotonic()
    remove()
    lost = flight.wait_for(_event("camera_lost"), _LOST_S, "camera_lost")
    lost_s = time.monotonic() - started_s
    vivid.until(lambda: not vivid.nodes(), 30.0, "no device node")
    time.sleep(3.0)
    started_s = time.monotonic()
    restore()
    flight.wait_for(_event("camera_opened"), _BACK_S, "camera_opened")
    back_s = time.monotonic() - started_s
    names = f"{before[0]} -> {vivid.node()}"
    return f"noticed after {lost_s:.1f} s ({lost.get('reason')}), open again {back_s:.1f} s after it came back, {names}"


def _remove() -> None:
    """Remove the driver; the kernel refuses while somebody has the device open, as it has to."""
    vivid.unbind()

    def gone() -> bool:
        return subprocess.run(["/usr/sbin/rmmod", "vivid"], capture_output=True, check=False).returncode == 0

    vivid.until(gone, 60.0, "rmmod vivid: the service keeps the device of an unplugged camera open")


def _end(flight: _Flight) -> str:
    flight.end()
    done = flight.wait_for(lambda said: said["phase"] == "done", 120.0, "the end of the flight")
    require(done["code"] == 0, f"companion run ended with code {done['code']}: {done['other_lines']}")
    require(
        done["armed"] is True and "OFFBOARD" in str(done["mode"]), f"autopilot left OFFBOARD: {done['mode']}"
    )
    require(done["z_changed"] == 0, f"z changed in {done['z_changed']} setpoints")
    require(done["other_altered"] == 0, f"{done['other_altered']} other messages altered")
    require(
        done["other_lost"] == 0,
        f"{done['other_lost']} of {done['other_sent']} other messages lost, by number: {done['missing_down']}",
    )
    require(
        done["setpoints_lost"] == 0, f"{done['setpoints_lost']} of {done['setpoints_sent']} setpoints lost"
    )
    return (
        f"{done['setpoints_sent']} setpoints and {done['other_sent']} other messages: none lost, none altered, z kept; "
        f"still {done['mode']}"
    )
