"""NavigationNet's naming: neighbours along the way that FRONT looks."""

import pytest

from detector.evaluation.dataset import DatasetError
from detector.evaluation.grid_dataset import is_grid, load_grid


@pytest.fixture
def grid(tmp_path):
    for row in range(3):
        for column in range(2):
            for facing in ("FRONT", "BACK"):
                for eye in ("LEFT", "RIGHT"):
                    (tmp_path / f"{row}_{column}_{facing}_{eye}.png").touch()
    (tmp_path / "2_1_FRONT_LEFT.png").unlink()
    (tmp_path / "map.png").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("facing", "expected"),
    [
        ("row+", [("0_0", "1_0"), ("0_1", "1_1"), ("1_0", "2_0")]),
        ("row-", [("1_0", "0_0"), ("1_1", "0_1"), ("2_0", "1_0")]),
        ("col+", [("0_0", "0_1"), ("1_0", "1_1")]),
        ("col-", [("0_1", "0_0"), ("1_1", "1_0")]),
    ],
)
def test_each_position_is_paired_with_the_next_one_ahead(grid, facing, expected):
    images = load_grid(grid, facing)
    ends = "_FRONT_LEFT.png"
    assert [(pair.a.removesuffix(ends), pair.b.removesuffix(ends)) for pair in images.pairs] == expected
    assert len(images.frames) == 5
    assert images.camera is None
    assert images.name == grid.name


def test_positions_count_as_numbers(tmp_path):
    for row in (9, 10):
        (tmp_path / f"{row}_3_FRONT_LEFT.png").touch()
    assert [(pair.a, pair.b) for pair in load_grid(tmp_path).pairs] == [
        ("9_3_FRONT_LEFT.png", "10_3_FRONT_LEFT.png")
    ]


def test_folders_without_such_names_or_neighbours_are_refused(tmp_path, grid):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert is_grid(grid)
    assert not is_grid(empty)
    assert not is_grid(tmp_path / "missing")
    with pytest.raises(DatasetError, match="no image is named"):
        load_grid(empty)
    (empty / "0_0_FRONT_LEFT.png").touch()
    (empty / "5_5_FRONT_LEFT.png").touch()
    with pytest.raises(DatasetError, match="none of 2 positions has a neighbour"):
        load_grid(empty)
    (empty / "00_0_FRONT_LEFT.png").touch()
    with pytest.raises(DatasetError, match="name one position"):
        load_grid(empty)
