"""What a suite's flights come to: figures by world and method, as JSON and as a Markdown table."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from companion.sim.suite import FAILED_SIMULATION, Finished, SuiteError

OUTCOMES: Final = ("reached", "collided", "stuck", "timeout", FAILED_SIMULATION)
OUTCOME_HEADS: Final = (*OUTCOMES[:-1], "failed")
"""As columns are headed."""

ALL_WORLDS: Final = "all"

_NOTE = """\
Succeeded: at the goal, or without a collision where the world says that nothing leads there. Failed: the simulation itself.
Clearance is the least of all flights; time and way are medians over those that reached the goal. The free ratio of a flight is its
median of (free distance in the direction answered) / (greatest free distance in view); here is the median of those."""


@dataclass(frozen=True, slots=True)
class Row:
    """The flights of one method in one world, or in all of them.

    Attributes
    ----------
    world, method
        Whose; ``all`` for every world.
    flights
        How many.
    outcomes
        How many ended in each way, in the order of ``OUTCOMES``.
    succeeded
        How many did.
    min_clearance_m
        Least distance to anything on any of them.
    time_s, path_m
        Medians over those that reached the goal.
    free_ratio
        Median of the flights' medians.
    """

    world: str
    method: str
    flights: int
    outcomes: tuple[int, ...]
    succeeded: int
    min_clearance_m: float | None
    time_s: float | None
    path_m: float | None
    free_ratio: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "world": self.world,
            "method": self.method,
            "flights": self.flights,
            **{
                outcome.replace(" ", "_"): count
                for outcome, count in zip(OUTCOMES, self.outcomes, strict=True)
            },
            "succeeded": self.succeeded,
            "min_clearance_m": self.min_clearance_m,
            "time_s": self.time_s,
            "path_m": self.path_m,
            "free_ratio": self.free_ratio,
        }


def rows_of(finished: Sequence[Finished]) -> tuple[Row, ...]:
    """Return a row for each world and method, then one for each method over all worlds, in the suite's order."""
    worlds = dict.fromkeys(flight.world for flight in finished)
    methods = dict.fromkeys(flight.flight.spec.method for flight in finished)
    rows = [
        _row(world, method, flown)
        for world in worlds
        for method in methods
        if (flown := [f for f in finished if f.world == world and f.flight.spec.method == method])
    ]
    if len(worlds) > 1:
        rows.extend(
            _row(ALL_WORLDS, method, [f for f in finished if f.flight.spec.method == method])
            for method in methods
        )
    return tuple(rows)


def report_json(finished: Sequence[Finished], folder: Path) -> str:
    """Return everything about a suite as JSON text; paths are relative to the folder where that is possible."""
    return json.dumps(
        {
            "summary": [row.as_dict() for row in rows_of(finished)],
            "flights": [
                {
                    "name": flight.flight.name,
                    "outcome": flight.outcome,
                    "succeeded": flight.succeeded,
                    "error": flight.error,
                    "record": _below(folder, flight.record),
                    "video": _below(folder, flight.video),
                    "spec": flight.flight.spec.as_dict(),
                    "result": flight.result,
                }
                for flight in finished
            ],
        },
        indent=1,
    )


def report_markdown(finished: Sequence[Finished], folder: Path) -> str:
    """Return the tables of a suite as Markdown: by world and method, then every flight, then what went wrong."""
    parts = [
        "# Simulated flights\n",
        _table(
            ("world", "method", "flights", *OUTCOME_HEADS, "succeeded", "clearance, m", "time, s", "way, m", "free ratio"),
            (
                (
                    row.world,
                    row.method,
                    row.flights,
                    *row.outcomes,
                    row.succeeded,
                    _figure(row.min_clearance_m, 2),
                    _figure(row.time_s, 1),
                    _figure(row.path_m, 1),
                    _figure(row.free_ratio, 2),
                )
                for row in rows_of(finished)
            ),
        ),
        f"{_NOTE}\n",
        "## Every flight\n",
        _table(
            ("world", "seed", "method", "outcome", "succeeded", "clearance, m", "time, s", "way, m", "decisions", "video"),
            (_flight_cells(flight, folder) for flight in finished),
        ),
    ]  # fmt: skip
    if failed := [flight for flight in finished if flight.error is not None]:
        parts.append("## What went wrong with the simulation\n")
        parts.append("".join(f"- {flight.flight.name}: {flight.error}\n" for flight in failed))
    return "\n".join(parts)


def write_report(finished: Sequence[Finished], folder: Path) -> None:
    """Write ``suite.json`` and ``suite.md`` into the suite's folder.

    Raises
    ------
    SuiteError
        When that is not possible.
    """
    for name, text in (
        ("suite.json", report_json(finished, folder) + "\n"),
        ("suite.md", report_markdown(finished, folder)),
    ):
        try:
            (folder / name).write_text(text, encoding="utf-8")
        except OSError as error:
            raise SuiteError(f"{folder / name}: cannot be written: {error.strerror}") from error


def _row(world: str, method: str, flown: Sequence[Finished]) -> Row:
    results = [flight.result for flight in flown if flight.result is not None]
    reached = [result for result in results if result["outcome"] == "reached"]
    return Row(
        world=world,
        method=method,
        flights=len(flown),
        outcomes=tuple(sum(flight.outcome == outcome for flight in flown) for outcome in OUTCOMES),
        succeeded=sum(flight.succeeded for flight in flown),
        min_clearance_m=_of(min, (result["min_clearance_m"] for result in results)),
        time_s=_of(statistics.median, (result["time_s"] for result in reached)),
        path_m=_of(statistics.median, (result["path_m"] for result in reached)),
        free_ratio=_of(statistics.median, (result["free_ratio_median"] for result in results)),
    )


def _of(summary: Callable[[list[float]], float], values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(summary(known), 3) if known else None


def _flight_cells(flight: Finished, folder: Path) -> tuple[object, ...]:
    result = flight.result or {}
    video = _below(folder, flight.video)
    return (
        flight.world,
        flight.flight.spec.seed,
        flight.flight.spec.method,
        flight.outcome,
        "yes" if flight.succeeded else "**no**",
        _figure(result.get("min_clearance_m"), 2),
        _figure(result.get("time_s"), 1),
        _figure(result.get("path_m"), 1),
        result.get("decisions", "-"),
        f"[video]({video})" if video else "-",
    )


def _below(folder: Path, path: Path | None) -> str | None:
    if path is None:
        return None
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"  # + 0.0: no minus before 0


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(_cell(item) for item in line) + " |\n" for line in lines)


def _cell(item: object) -> str:
    return str(item).replace("|", "\\|").replace("\n", " ")
