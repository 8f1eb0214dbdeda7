"""The picture sheet: each flight where it belongs, its path in the colour of its outcome."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.errors import CompanionError
from companion.sim.flight import FlightSpec
from companion.sim.flight_record import FlightRecorder
from companion.sim.suite import Ending, plan_flights, run_suite
from companion.sim.suite_sheet import OUTCOME_COLOURS, TILE_PX, sheet, tile, write_sheet
from companion.sim.suite_worlds import world_of
from companion.sim.world.file import load_world

WORLD = load_world("corridor")
WORDS = ("corridor 1 off", "reached")


def pixels_of(picture, colour) -> int:
    """Pixels near that colour; drawing smooths edges."""
    return int((np.abs(picture.astype(int) - colour).max(axis=-1) < 30).sum())


def straight_way(share: float) -> np.ndarray:
    start, goal = ((place.north_m, place.east_m) for place in (WORLD.start, WORLD.goal))
    return np.array(start) + np.linspace(0.0, share, 30)[:, None] * (np.array(goal) - start)


@pytest.mark.parametrize("outcome", ["reached", "stuck", "timeout"])
def test_a_longer_path_has_more_of_its_colour(outcome):
    colour = OUTCOME_COLOURS[outcome]
    none, half, whole = (
        pixels_of(tile(WORLD, way, colour, ("", "")), colour)
        for way in (np.empty((0, 2)), straight_way(0.5), straight_way(1.0))
    )
    assert none < half < whole


def test_every_shape_of_world_fits_its_tile():
    for name in ("corridor", "room", "lcorridor"):
        picture = tile(load_world(name), np.empty((0, 2)), (0, 0, 0), WORDS)
        assert picture.shape[1] == TILE_PX
        walls = np.argwhere(np.abs(picture[:TILE_PX].astype(int) - 95).max(axis=-1) < 10)
        spans = walls.max(axis=0) - walls.min(axis=0)
        assert 0.8 * TILE_PX < spans.max() < TILE_PX  # as large as there is room


def test_tiles_fill_rows_in_their_order():
    tiles = [np.full((10, 20, 3), shade, dtype=np.uint8) for shade in range(7)]
    picture = sheet(tiles)
    assert picture.shape == (20, 80, 3)
    assert picture[5, 10::20, 0].tolist() == [0, 1, 2, 3]
    assert picture[15, 10::20, 0].tolist() == [4, 5, 6, 255]


def test_a_sheet_that_would_be_too_large_has_smaller_tiles():
    tiles = [np.full((300, 240, 3), shade, dtype=np.uint8) for shade in range(100)]
    picture = sheet(tiles, largest_side_px=500)
    assert 450 <= max(picture.shape) <= 500
    # All of them are there.
    assert set(range(100)) <= set(np.unique(picture).tolist())


def write(tmp_path, record: bytes | None):
    flights = plan_flights(["corridor", "deadend"], [1], ["off"], FlightSpec())
    ending = Ending(result={"outcome": "stuck"}, succeeded=True, record=record)
    finished = run_suite(flights, tmp_path, lambda missing: ((flight, ending) for flight in missing))
    write_sheet(finished, tmp_path / "sheet.png", world_of)
    return cv2.imread(str(tmp_path / "sheet.png"))


def test_the_sheet_is_a_picture_file_with_a_tile_a_flight_and_paths_from_the_records(tmp_path):
    recorder = FlightRecorder()
    stored = tmp_path / "record.npz"
    record = recorder.record([], {})
    columns = {"position_ned_m": np.column_stack([straight_way(0.6), np.full(30, -1.2)])}
    type(record)(**{**vars(record), **columns}).save(stored)
    with_path, without = write(tmp_path / "a", stored.read_bytes()), write(tmp_path / "b", None)
    assert with_path.shape[1] == 2 * TILE_PX
    stuck = OUTCOME_COLOURS["stuck"]
    assert pixels_of(with_path, stuck) > pixels_of(without, stuck) + 100


def test_a_record_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(CompanionError, match=r"corridor-s1-off\.npz: not a flight record"):
        write(tmp_path, b"no record")
