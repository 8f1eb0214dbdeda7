"""The program that flies one flight of a suite: ``python -m companion.sim.suite_flight FOLDER``.

It reads ``flight.json`` in the folder and leaves ``result.json`` and ``record.npz`` there.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from companion.errors import CompanionError
from companion.sim.flight import run_flight
from companion.sim.flight_worlds import place_in
from companion.sim.suite import PlannedFlight
from companion.sim.suite_worlds import world_of


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, and return the exit code: 0 also where the simulation failed for a reason that it can give."""
    (name,) = sys.argv[1:] if argv is None else argv
    folder = Path(name)
    flight = PlannedFlight.from_dict(json.loads((folder / "flight.json").read_text(encoding="utf-8")))
    try:
        answer = fly(flight, folder)
    except CompanionError as error:
        answer = {"error": " ".join(str(error).split())}
    (folder / "result.json").write_text(json.dumps(answer), encoding="utf-8")
    return 0


def fly(flight: PlannedFlight, folder: Path) -> Mapping[str, Any]:
    """Fly and return what goes into ``result.json``."""
    world = world_of(flight)
    result = run_flight(flight.spec, place_in(world), record=folder / "record.npz")
    wanted = result.outcome == "reached" if world.goal_reachable else result.outcome != "collided"
    return {"result": result.as_dict(), "succeeded": wanted}


if __name__ == "__main__":
    raise SystemExit(main())
