"""Frames of a grid of robot positions, named ``ROW_COL_FACING_EYE.png`` as in NavigationNet (Huang et al., 2018).

The paper uses the front camera of that set. What the names mean is taken from the names alone, so these are assumptions: ROW and COL are the
robot's place on a grid of equal steps, FACING is a heading fixed to the grid and not to the robot's way, EYE is the left or
right camera of a stereo pair. Which way FRONT looks along the grid is not said: it is a parameter.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final, Literal

from detector.evaluation.dataset import DatasetError, Frame, ImageSet, Pair

Facing = Literal["row+", "row-", "col+", "col-"]
"""What counts up or down when the robot moves the way that FRONT looks."""

FACINGS: Final[dict[Facing, tuple[int, int]]] = {
    "row+": (1, 0),
    "row-": (-1, 0),
    "col+": (0, 1),
    "col-": (0, -1),
}
"""The step ahead, (rows, columns)."""

_NAME: Final = re.compile(r"(-?\d+)_(-?\d+)_FRONT_LEFT\.png", re.IGNORECASE)


def is_grid(folder: Path) -> bool:
    """Return whether a folder holds images of this naming."""
    return folder.is_dir() and any(_NAME.fullmatch(path.name) for path in folder.iterdir())


def load_grid(folder: Path, facing: Facing = "row+") -> ImageSet:
    """Return the left front images of a folder, and as pairs each position with its neighbour one step ahead.

    No size, camera, pose or truth is known: what can be had are answers and their time.

    Parameters
    ----------
    folder
        Of the images.
    facing
        Which neighbour lies ahead.

    Raises
    ------
    DatasetError
        No image has such a name, or no two of them are neighbours along the facing direction.
    """
    places: dict[tuple[int, int], str] = {}
    for path in sorted(folder.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match is not None:
            place = (int(match[1]), int(match[2]))
            if place in places:
                raise DatasetError(f"{folder}: {places[place]} and {path.name} name one position")
            places[place] = path.name
    if not places:
        raise DatasetError(f"{folder}: no image is named ROW_COL_FRONT_LEFT.png")
    rows, columns = FACINGS[facing]
    pairs = tuple(
        Pair(a=name, b=places[row + rows, column + columns])
        for (row, column), name in sorted(places.items())
        if (row + rows, column + columns) in places
    )
    if not pairs:
        raise DatasetError(
            f"{folder}: none of {len(places)} positions has a neighbour one step ahead ({facing})"
        )
    frames = {name: Frame() for _, name in sorted(places.items())}
    return ImageSet(folder.resolve().name, folder, None, None, frames, pairs)
