"""A picture sheet of a suite: every flight from above, its path in the colour of its outcome."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.sim.flight_record import FlightRecord
from companion.sim.suite import FAILED_SIMULATION, Finished, PlannedFlight, SuiteError
from companion.sim.world.clearance import VEHICLE_RADIUS_M
from companion.sim.world.model import World
from companion.sim.world.top_view import Colour, top_view

Image = NDArray[np.uint8]

TILE_PX: Final = 240
_LABEL_PX: Final = 34
_EDGE_PX: Final = 8
LARGEST_SIDE_PX: Final = 10_000
_TRIAL_PX_PER_M: Final = 20.0

_INK: Final[Colour] = (40, 40, 40)
OUTCOME_COLOURS: Final[Mapping[str, Colour]] = MappingProxyType(
    {
        "reached": (60, 150, 40),
        "collided": (40, 40, 220),
        "stuck": (20, 140, 240),
        "timeout": (200, 90, 20),
        FAILED_SIMULATION: (150, 150, 150),
    }
)
"""BGR."""


def write_sheet(finished: Sequence[Finished], path: Path, world_of: Callable[[PlannedFlight], World]) -> None:
    """Draw the sheet of a suite and write it as PNG.

    Parameters
    ----------
    finished
        Its flights.
    path
        The file.
    world_of
        Gives the world that a flight was flown in.

    Raises
    ------
    companion.errors.CompanionError
        When a record cannot be read or the file cannot be written.
    """
    tiles = [_tile_of(flight, world_of(flight.flight)) for flight in finished]
    encoded, data = cv2.imencode(".png", sheet(tiles))
    if not encoded:
        raise SuiteError(f"{path}: the picture sheet cannot be encoded")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise SuiteError(f"{path}: cannot be written: {error.strerror}") from error


def sheet(tiles: Sequence[Image], *, largest_side_px: int = LARGEST_SIDE_PX) -> Image:
    """Return tiles of one size side by side in rows, in their order; smaller where the picture would be too large."""
    if not tiles:
        raise ValueError("a sheet needs at least one tile")
    columns = min(math.ceil(math.sqrt(1.5 * len(tiles))), len(tiles))
    rows = math.ceil(len(tiles) / columns)
    height_px, width_px = tiles[0].shape[:2]
    factor = min(1.0, largest_side_px / max(rows * height_px, columns * width_px))
    height_px, width_px = math.floor(height_px * factor), math.floor(width_px * factor)
    picture = np.full((rows * height_px, columns * width_px, 3), 255, dtype=np.uint8)
    for index, whole in enumerate(tiles):
        top, left = index // columns * height_px, index % columns * width_px
        small = cv2.resize(whole, (width_px, height_px), interpolation=cv2.INTER_AREA)
        picture[top : top + height_px, left : left + width_px] = small
    return picture


def tile(
    world: World,
    path_m: NDArray[np.float64],
    colour: Colour,
    words: tuple[str, str],
    *,
    side_px: int = TILE_PX,
) -> Image:
    """Return one flight from above, north up and east to the right, with two lines of words below.

    Parameters
    ----------
    world
        Where, drawn as ``top_view`` has it.
    path_m
        (n, 2) float64, [north, east]; may be empty.
    colour
        Of the path, BGR.
    words
        What it was, and how it ended.
    side_px
        Width, and height without the words.
    """
    picture = np.full((side_px + _LABEL_PX, side_px, 3), 255, dtype=np.uint8)
    room_px = side_px - 2 * _EDGE_PX
    largest_px = max(top_view(world, px_per_m=_TRIAL_PX_PER_M).image.shape)
    view = top_view(world, px_per_m=_TRIAL_PX_PER_M * room_px / largest_px, with_reference_path=False)
    if len(path_m):
        view.draw_path(path_m, colour)
        view.draw_disc(path_m[-1], VEHICLE_RADIUS_M, colour, 1)
    height_px, width_px = view.image.shape[:2]
    top, left = (side_px - height_px) // 2, (side_px - width_px) // 2
    picture[top : top + height_px, left : left + width_px] = view.image
    for line, text in enumerate(words):
        at = (_EDGE_PX, side_px + 11 + 15 * line)
        ink = _INK if line == 0 else colour
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, ink, 1, cv2.LINE_AA)
    return picture


def _tile_of(flight: Finished, world: World) -> Image:
    path_m = np.empty((0, 2))
    if flight.record is not None:
        path_m = FlightRecord.load(flight.record).position_ned_m[:, :2]
    reached = flight.outcome == "reached"
    ended = flight.outcome if flight.succeeded == reached else f"{flight.outcome}, succeeded"
    spec = flight.flight.spec
    return tile(
        world,
        path_m,
        OUTCOME_COLOURS[flight.outcome],
        (f"{flight.world} {spec.seed} {spec.method}", ended),
    )
