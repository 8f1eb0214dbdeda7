"""The program that flies one flight of a suite: ``python -m companion.sim.suite_flight FOLDER``.

It reads ``flight.json`` in the folder and leaves ``result.json``, ``record.npz`` and, of a flight that did not succeed,
``video.mp4`` there.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from companion.errors import CompanionError
from companion.sim.flight import fly_and_judge
from companion.sim.flight_loop import camera_model_of
from companion.sim.flight_record import FlightRecord
from companion.sim.flight_video import write_flight_video
from companion.sim.flight_worlds import place_in
from companion.sim.suite import PlannedFlight
from companion.sim.suite_worlds import world_of
from companion.sim.world.model import World


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, and return the exit code: 0 also where the simulation failed for a reason that it can give."""
    (name,) = sys.argv[1:] if argv is None else argv
    folder = Path(name)
    flight = PlannedFlight.from_dict(json.loads((folder / "flight.json").read_text(encoding="utf-8")))
    answer: dict[str, Any] = {}
    try:
        world = world_of(flight)
        answer, record = _flown(flight, world, folder)
        # The flight counts whatever becomes of its video.
        _write(folder, answer)
        if not answer["succeeded"]:
            write_flight_video(record, world, camera_model_of(flight.spec), folder / "video.mp4")
    except CompanionError as error:
        _write(folder, {**answer, "error": " ".join(str(error).split())})
    return 0


def _flown(flight: PlannedFlight, world: World, folder: Path) -> tuple[dict[str, Any], FlightRecord]:
    result, record = fly_and_judge(flight.spec, place_in(world))
    record.save(folder / "record.npz")
    succeeded = result.outcome == "reached" if world.goal_reachable else result.outcome != "collided"
    return {"result": result.as_dict(), "succeeded": succeeded}, record


def _write(folder: Path, answer: Mapping[str, Any]) -> None:
    (folder / "result.json").write_text(json.dumps(answer), encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
