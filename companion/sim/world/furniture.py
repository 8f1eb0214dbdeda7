"""Furniture: meshes of the miniworld wheel, brought to a true size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

FurnitureKind = Literal["desk", "office_chair", "barrel", "cone", "barrier", "plant", "pine", "crate"]


@dataclass(frozen=True, slots=True)
class Mesh:
    """One mesh and how large it stands in a world.

    A mesh's own axes are x, y up and z. In a world x goes along the piece's heading, y up, and z to the right of
    the heading as seen from above (which keeps it from being mirrored); the middle of its bounding box in x and z
    comes to stand on the piece's centre, its lowest y on the floor.

    Attributes
    ----------
    file
        Below the wheel's ``miniworld/meshes``; None for a plain cube that wears ``texture``.
    low, high
        Corners of the mesh's bounding box in its own units, (x, y, z).
    height_m
        Of the whole piece at scale 1; its width and depth follow from the bounding box.
    texture
        Of a cube; a mesh has its own.
    """

    file: str | None
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    height_m: float
    texture: str | None = None

    @property
    def metres_per_unit(self) -> float:
        """Factor from the mesh's units to metres at scale 1."""
        return self.height_m / (self.high[1] - self.low[1])

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Length along the heading, width across it, and height, at scale 1."""
        factor = self.metres_per_unit
        along, up, across = ((high - low) * factor for low, high in zip(self.low, self.high, strict=True))
        return along, across, up


MESHES: Final[Mapping[str, Mesh]] = MappingProxyType(
    {
        "desk": Mesh("office_desk.obj", (-8.2337, 0.0019, -16.4497), (58.6822, 63.6348, 16.4528), 1.2),
        "office_chair": Mesh(
            "office_chair.obj", (-14.441, 0.0237, -12.5489), (14.4322, 47.3383, 14.9111), 1.1
        ),
        "barrel": Mesh("barrel.obj", (-0.3054, 0.0, -0.3053), (0.3054, 0.8823, 0.3055), 0.88),
        "cone": Mesh("cone.obj", (-10.0, 0.0, -10.0), (10.0, 31.5229, 10.0), 0.75),
        "barrier": Mesh("barrier.obj", (-2.0328, 0.0, -0.4064), (2.0328, 1.143, 0.4064), 0.85),
        "plant": Mesh("tree.obj", (-14.0619, -0.7426, -13.472), (13.9192, 25.7991, 7.3297), 1.3),
        "pine": Mesh("tree_pine.obj", (-2.3356, 0.0096, -0.4003), (1.3482, 7.5535, 3.2835), 2.2),
        "crate": Mesh(None, (-0.5, 0.0, -0.5), (0.5, 1.0, 0.5), 0.8, "cardboard_3"),
    }
)
"""Every ``FurnitureKind``. The bounding boxes are those of miniworld 2.1.0; a test compares them where it is installed."""
