"""The same flight with a setting too small, as it should be, and too large: pictures and figures for docs/tuning.md.

    .venv/bin/python -m benchmarks.tuning_pictures docs/images [--only NAME]

Needs the extra ``sim``. Flies in simulated time, so that the pictures are the same every time; each takes under a minute.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.sim.flight import FlightSpec, run_flight
from companion.sim.flight_record import FlightRecord
from companion.sim.flight_worlds import find_world
from companion.sim.world.model import World
from companion.sim.world.top_view import top_view

SEED = 3
TIME_LIMIT_S = 45.0
PANEL_PX = (300, 240)
VEHICLE_RADIUS_M = 0.35
GREEN, RED, DARK, WHITE = (60, 140, 40), (50, 50, 210), (40, 40, 40), (255, 255, 255)


@dataclass(frozen=True)
class Study:
    """One setting, its values, and the world that shows what they do; the middle value is right."""

    name: str
    table: str
    key: str
    values: tuple[float, float, float]
    world: str


STUDIES = (
    Study("margin", "guidance", "step_margin_m", (0.1, 0.8, 2.0), "door"),
    Study("width", "detector", "vehicle_width_m", (0.3, 0.9, 1.6), "door"),
    Study("hfov", "camera", "hfov_deg", (60.0, 75.0, 110.0), "room"),
    Study("mount-yaw", "camera", "mount_yaw_deg", (-20.0, 0.0, 20.0), "corridor"),
    Study("step", "guidance", "max_step_m", (0.4, 1.5, 4.0), "room"),
)


def fly(study: Study, value: float, folder: Path) -> tuple[str, FlightRecord]:
    """Fly with one value, or take the record of that very flight; return a line about it, and its record."""
    right = value == study.values[1]
    path = folder / (f"{study.world}.npz" if right else f"{study.name}-{value:g}.npz")
    if not path.exists():
        settings = {} if right else {study.table: {study.key: value}}
        spec = FlightSpec(world=study.world, seed=SEED, time_limit_s=TIME_LIMIT_S, settings=settings)
        run_flight(spec, record=path)
    record = FlightRecord.load(path)
    result = record.about["result"]
    states = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in sorted(result["states"].items()))
    print(
        f"{study.key} = {value:g}: {result['outcome']} after {result['time_s']:.0f} s, {result['path_m']:.1f} m, "
        f"least clearance {result['min_clearance_m']:.2f} m; {states}",
        flush=True,
    )
    return f"{result['outcome']}, {result['time_s']:.0f} s", record


def panel(world: World, record: FlightRecord, title: str, outcome: str) -> NDArray[np.uint8]:
    """Return the way that was flown, from above."""
    width, height = PANEL_PX
    room = height - 46
    rough = top_view(world, px_per_m=10.0, with_reference_path=False).image
    scale = min(10.0 * room / rough.shape[0], 10.0 * (width - 8) / rough.shape[1])
    plan = top_view(world, px_per_m=0.98 * scale, with_reference_path=False)
    plan.draw_path(record.position_ned_m, GREEN)
    plan.draw_disc(record.position_ned_m[-1], VEHICLE_RADIUS_M, RED if "collided" in outcome else GREEN, 2)
    sheet = np.full((height, width, 3), 255, dtype=np.uint8)
    top = 40 + (room - plan.image.shape[0]) // 2
    left = (width - plan.image.shape[1]) // 2
    sheet[top : top + plan.image.shape[0], left : left + plan.image.shape[1]] = plan.image
    for row, words in enumerate((title, outcome)):
        cv2.putText(sheet, words, (6, 15 + 18 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, DARK, 1, cv2.LINE_AA)
    return sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=[study.name for study in STUDIES])
    parser.add_argument(
        "--records",
        type=Path,
        default=Path("out/tuning"),
        help="where flights are kept; empty it to fly anew",
    )
    arguments = parser.parse_args()
    arguments.records.mkdir(parents=True, exist_ok=True)
    for study in STUDIES:
        if arguments.only not in (None, study.name):
            continue
        world = find_world(study.world)
        panels = []
        for value in study.values:
            outcome, record = fly(study, value, arguments.records)
            panels.append(panel(world, record, f"{study.key} = {value:g}", outcome))
        cv2.imwrite(
            str(arguments.folder / f"tuning-{study.name}.webp"),
            np.hstack(panels),
            [cv2.IMWRITE_WEBP_QUALITY, 70],
        )


if __name__ == "__main__":
    main()
