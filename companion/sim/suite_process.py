"""One flight of a suite in a process of its own: a crash, a leak or a hang there is that flight's alone.

A program beside this one (``companion.sim.suite_flight``) flies in a temporary folder; what it leaves there comes back as bytes, so that
this works as well on another machine that shares no disk.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from companion.sim.suite import Ending, PlannedFlight

PROGRAM: Final = (sys.executable, "-m", "companion.sim.suite_flight")
TIME_LIMIT_S: Final = 3600.0
_END_S: Final = 5.0
_LOG_BYTES: Final = 40_000
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class FlightProcesses:
    """Flies flights, each in a process; may be used by several threads at once.

    Parameters
    ----------
    program
        Takes the folder of the flight as its last argument (``companion.sim.suite_flight``).
    time_limit_s
        A simulation that takes longer, in real time, has failed.
    """

    def __init__(self, program: Sequence[str] = PROGRAM, *, time_limit_s: float = TIME_LIMIT_S) -> None:
        self._program = tuple(program)
        self._time_limit_s = time_limit_s
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def fly(self, flight: PlannedFlight) -> Ending:
        """Fly one flight to its end; a simulation that fails is an ending too."""
        try:
            return self._fly(flight)
        except OSError as error:  # no room for its files, no process to be had
            return Ending(error=f"the simulation could not be run: {error}")

    def stop(self) -> None:
        """End all flights that fly, and begin no other; ``fly`` returns in their threads."""
        with self._lock:
            self._stopped = True
            running = tuple(self._running)
        for process in running:
            _signal_group(process, signal.SIGTERM)
        for process in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_END_S)
            _signal_group(process, signal.SIGKILL)

    def _fly(self, flight: PlannedFlight) -> Ending:
        with tempfile.TemporaryDirectory(prefix="flight-") as name:
            folder = Path(name)
            (folder / "flight.json").write_text(json.dumps(flight.as_dict()), encoding="utf-8")
            with (folder / "log").open("wb") as log:
                error = self._run(folder, log.fileno())
            text = _tail(folder / "log")
            answer = _answer(folder / "result.json")
            if answer is None:
                return Ending(error=error or "the simulation ended without a result", log=text)
            error = error or answer.get("error")
            if "result" not in answer:
                return Ending(error=error, log=text)
            return Ending(
                result=answer["result"],
                succeeded=answer["succeeded"],
                error=error,
                record=_bytes(folder / "record.npz"),
                # What went wrong after the flight went wrong with its video.
                video=None if error else _bytes(folder / "video.mp4"),
                log=text,
            )

    def _run(self, folder: Path, log: int) -> str | None:
        """Run the program there and return what went wrong."""
        environment = {**dict.fromkeys(_THREADS, "1"), **os.environ}
        with self._lock:
            if self._stopped:
                return "stopped"
            # A session of its own: Ctrl-C in the terminal reaches us, and we decide when flights end.
            process = subprocess.Popen(
                [*self._program, str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
            self._running.add(process)
        try:
            code = process.wait(self._time_limit_s)
        except subprocess.TimeoutExpired:
            return f"the simulation was ended after {self._time_limit_s:g} s"
        finally:
            # Whatever it has started goes with it.
            _signal_group(process, signal.SIGKILL)
            process.wait()
            with self._lock:
                self._running.discard(process)
        if code < 0:
            return f"the simulation was ended by {_signal_name(-code)}"
        if code > 0:
            return f"the simulation failed: {_last_line(folder / 'log')} (exit code {code})"
        return None


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):  # nothing of it is left
        os.killpg(process.pid, number)


def _signal_name(number: int) -> str:
    with contextlib.suppress(ValueError):
        return signal.Signals(number).name
    return f"signal {number}"


def _answer(path: Path) -> Mapping[str, Any] | None:
    try:
        answer: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return answer


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def _tail(path: Path) -> str:
    return path.read_bytes()[-_LOG_BYTES:].decode(errors="replace")


def _last_line(path: Path) -> str:
    lines = [line.strip() for line in _tail(path).splitlines() if line.strip()]
    return lines[-1] if lines else "without a word"
