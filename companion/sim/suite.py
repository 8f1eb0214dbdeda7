"""A suite of simulated flights: which ones, where their files are, and which of them have been flown.

Each flight has a JSON file of its own in the suite's folder, written when it is over. A suite that is started again in
the same folder flies what is missing there, and what the simulation failed at.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from companion.errors import CompanionError
from companion.sim.flight import FlightSpec, Method

FLIGHTS_FOLDER: Final = "flights"
FAILED_SIMULATION: Final = "failed simulation"
"""Outcome of a flight that could not be simulated to its end."""


class SuiteError(CompanionError):
    """A suite cannot be flown as it was asked for, or its folder cannot be used."""


@dataclass(frozen=True, slots=True)
class PlannedFlight:
    """One flight of a suite.

    Attributes
    ----------
    name
        Its own in the suite; its files are called so.
    spec
        Which flight. Where its world is a file, ``spec.world`` is the name of that file without its folder.
    world_toml
        The text of the world's file, so that it can be flown on a machine that has not got it; None for a built-in
        or random world.
    """

    name: str
    spec: FlightSpec
    world_toml: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {"name": self.name, "spec": self.spec.as_dict(), "world_toml": self.world_toml}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> PlannedFlight:
        """Read what ``as_dict`` gave."""
        return cls(values["name"], FlightSpec.from_dict(values["spec"]), values["world_toml"])


@dataclass(frozen=True, slots=True)
class Ending:
    """What came back from one flight, wherever it was flown.

    Attributes
    ----------
    result
        ``FlightResult.as_dict()``; None where the simulation failed.
    succeeded
        Whether it ended at the goal, or without a collision in a world where nothing leads there.
    error
        Why the simulation failed, or why a flight that it did to its end has no video; one line. None where
        nothing went wrong.
    record, video
        The files' contents, where there are such files.
    log
        What the simulation wrote, its end.
    """

    result: Mapping[str, Any] | None = None
    succeeded: bool = False
    error: str | None = None
    record: bytes | None = None
    video: bytes | None = None
    log: str = ""


@dataclass(frozen=True, slots=True)
class Finished:
    """A flight with its ending, as the suite's folder keeps it.

    Attributes
    ----------
    flight
        Which one.
    outcome
        That of ``FlightResult``, or ``failed simulation``.
    succeeded, result, error
        As in ``Ending``.
    record, video
        Paths of its files, None where it has none.
    """

    flight: PlannedFlight
    outcome: str
    succeeded: bool
    result: Mapping[str, Any] | None
    error: str | None
    record: Path | None
    video: Path | None

    @property
    def world(self) -> str:
        """The world's name as it was asked for, a random one with its difficulty."""
        return world_label(self.flight.spec)


Endings = Generator[tuple[PlannedFlight, Ending], None, None]
FlyAll = Callable[[Sequence[PlannedFlight]], Endings]
"""Flies them in any order and gives each with its ending. Closing the generator ends what still flies."""


def world_label(spec: FlightSpec) -> str:
    """Return what a flight's world is called in tables: random worlds with their difficulty."""
    return f"random {spec.difficulty}" if spec.world == "random" else spec.world


def plan_flights(
    worlds: Sequence[str], seeds: Sequence[int], methods: Sequence[Method], template: FlightSpec
) -> tuple[PlannedFlight, ...]:
    """Return every world with every seed and every method.

    Parameters
    ----------
    worlds
        Names of built-in worlds, paths of world files (``.toml``), or ``random``.
    seeds, methods
        As in ``FlightSpec``.
    template
        The rest of each specification.

    Raises
    ------
    companion.errors.CompanionError
        When a file cannot be read, or two flights would have the same name.
    """
    if not (worlds and seeds and methods):
        raise SuiteError("a suite needs at least one world, one seed and one method")
    flights: list[PlannedFlight] = []
    for asked in worlds:
        world, text = (Path(asked).name, _text_of(Path(asked))) if asked.endswith(".toml") else (asked, None)
        for seed in seeds:
            for method in methods:
                spec = dataclasses.replace(template, world=world, seed=seed, method=method)
                stem = world_label(spec).removesuffix(".toml").replace(" ", "-")
                flights.append(PlannedFlight(f"{stem}-s{seed}-{method}", spec, text))
    counts = Counter(flight.name for flight in flights)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise SuiteError(
            f"the flight {twice[0]} is asked for twice: worlds, seeds and methods must each differ, files in their names"
        )
    return tuple(flights)


def run_suite(
    flights: Sequence[PlannedFlight],
    folder: Path,
    fly_all: FlyAll,
    on_finished: Callable[[Finished], None] = lambda _: None,
) -> tuple[Finished, ...]:
    """Fly what the folder has not got yet, and keep each ending there as it comes.

    Parameters
    ----------
    flights
        The suite.
    folder
        Its folder; made where it is missing.
    fly_all
        Where and how many at a time.
    on_finished
        Told of each flight when its files are written.

    Returns
    -------
    All flights with their endings, in the order of ``flights``.

    Raises
    ------
    SuiteError
        When the folder cannot be used, or has flights of the same names that were flown with other settings.
    """
    try:
        (folder / FLIGHTS_FOLDER).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SuiteError(f"{folder}: cannot be made a suite's folder: {error.strerror}") from error
    done = finished_flights(flights, folder)
    missing = [flight for flight in flights if flight.name not in done]
    if missing:
        with closing(fly_all(missing)) as endings:
            for flight, ending in endings:
                done[flight.name] = finished = _keep(folder, flight, ending)
                on_finished(finished)
    return tuple(done[flight.name] for flight in flights)


def finished_flights(flights: Sequence[PlannedFlight], folder: Path) -> dict[str, Finished]:
    """Return, by name, those flights that the folder has; what the simulation failed at does not count.

    Raises
    ------
    SuiteError
        When one of that name was flown with other settings, or its file cannot be read.
    """
    finished: dict[str, Finished] = {}
    for flight in flights:
        path = _path(folder, flight, "json")
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            flown = PlannedFlight.from_dict(kept["flight"])
        except FileNotFoundError:
            continue
        except OSError as error:
            raise SuiteError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, KeyError, TypeError, CompanionError) as error:
            raise SuiteError(f"{path}: not a flight of this version; give another folder") from error
        if flown != flight:
            raise SuiteError(f"{path}: was flown with other settings; give another folder for this suite")
        if kept["result"] is not None:
            finished[flight.name] = _finished(
                folder, flight, kept["result"], kept["succeeded"], kept["error"]
            )
    return finished


def _keep(folder: Path, flight: PlannedFlight, ending: Ending) -> Finished:
    """Write a flight's files; its JSON last and at once, because it says that the flight is finished."""
    contents = {
        "npz": ending.record,
        "mp4": ending.video,
        # A log is of use where there is nothing else to look at.
        "log": ending.log.encode() if ending.result is None else None,
    }
    text = json.dumps(
        {
            "flight": flight.as_dict(),
            "result": ending.result,
            "succeeded": ending.succeeded,
            "error": ending.error,
        },
        indent=1,
    )
    path = _path(folder, flight, "json")
    try:
        for suffix, content in contents.items():
            file = _path(folder, flight, suffix)
            if content is None:
                file.unlink(missing_ok=True)  # of an earlier try
            else:
                file.write_bytes(content)
        half_written = path.with_suffix(".json.part")
        half_written.write_text(text + "\n", encoding="utf-8")
        half_written.replace(path)
    except OSError as error:
        raise SuiteError(f"{path}: cannot be written: {error.strerror}") from error
    return _finished(folder, flight, ending.result, ending.succeeded, ending.error)


def _finished(
    folder: Path,
    flight: PlannedFlight,
    result: Mapping[str, Any] | None,
    succeeded: bool,
    error: str | None,
) -> Finished:
    record, video = (_path(folder, flight, suffix) for suffix in ("npz", "mp4"))
    return Finished(
        flight=flight,
        outcome=FAILED_SIMULATION if result is None else str(result["outcome"]),
        succeeded=succeeded,
        result=result,
        error=error,
        record=record if record.exists() else None,
        video=video if video.exists() else None,
    )


def _path(folder: Path, flight: PlannedFlight, suffix: str) -> Path:
    return folder / FLIGHTS_FOLDER / f"{flight.name}.{suffix}"


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise SuiteError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise SuiteError(f"{path}: cannot be read: {error}") from error
