"""The names of textures: pictures of the miniworld wheel, or one plain colour.

The pictures themselves stay in that wheel (no licence is stated for them one by one); a world only names them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

PLAIN_PREFIX: Final = "plain:"
_PLAIN = re.compile(r"plain:#[0-9a-fA-F]{6}")
_PORTRAIT = re.compile(r"portraits/[a-z0-9_-]{1,80}")

TILE_SIDE_M: Final[Mapping[str, float]] = MappingProxyType(
    {
        "airduct_grate_1": 1.0,
        "asphalt_1": 1.0,
        "brick_wall_1": 2.0,
        "cardboard_1": 1.0,
        "cardboard_2": 1.0,
        "cardboard_3": 1.0,
        "cardboard_4": 0.5,
        "ceiling_tile_noborder_1": 1.0,
        "ceiling_tiles_1": 1.0,
        "cinder_blocks_1": 2.0,
        "concrete_1": 1.0,
        "concrete_2": 1.0,
        "concrete_3": 1.5,
        "concrete_4": 1.0,
        "concrete_tiles_1": 1.5,
        "door_doom_1": 2.0,
        "door_doom_2": 2.0,
        "door_garage_red": 2.0,
        "door_garage_white": 2.0,
        "door_steel_brown": 2.0,
        "door_steel_grey": 2.0,
        "door_steel_red": 2.0,
        "drywall_1": 1.0,
        "floor_tiles_bw_1": 1.0,
        "floor_tiles_white": 1.0,
        "grass_1": 2.0,
        "grass_2": 2.0,
        "logo_mila_1": 2.0,
        "marble_1": 1.0,
        "marble_2": 1.0,
        "metal_grill_1": 1.0,
        "metal_grill_2": 2.0,
        "rock_1": 2.0,
        "stucco_1": 1.0,
        "white_1": 1.0,
        "wood_1": 1.0,
        "wood_2": 1.0,
        "wood_planks_1": 2.0,
    }
)
"""Every texture that can cover a surface, with the side of the square that one copy of it covers, m."""


PAINTINGS: Final = (
    "portraits/antonello_messina1",
    "portraits/byron1",
    "portraits/cranach_lucas2",
    "portraits/felix_bonfils1",
    "portraits/francesco_hayez1",
    "portraits/gaston_bussiere1",
    "portraits/george_henry_hall1",
    "portraits/giovanni_bellini1",
    "portraits/hans_holbein1",
    "portraits/jean-leon_gerome3",
    "portraits/julije_klovic1",
    "portraits/kiprenskij_orest_adamovic1",
    "portraits/marie_bashkirtseff1",
    "portraits/paolo_veronese1",
    "portraits/richard_bergh1",
    "portraits/velazquez_diego1",
)
"""Some of the wheel's paintings."""


def checked_texture(name: str) -> str:
    """Return a texture's name when it is one.

    Parameters
    ----------
    name
        A key of ``TILE_SIDE_M``; ``portraits/NAME`` (a painting of the wheel); or ``plain:#rrggbb``.

    Raises
    ------
    ValueError
        When it is none; says what is allowed.
    """
    if name in TILE_SIDE_M or _PLAIN.fullmatch(name) or _PORTRAIT.fullmatch(name):
        return name
    raise ValueError(f"plain:#rrggbb, portraits/NAME, or one of {', '.join(TILE_SIDE_M)}")


def plain_colour_rgb(name: str) -> tuple[int, int, int] | None:
    """Return the colour (0 to 255) of a ``plain:#rrggbb`` texture, or None for a picture."""
    if not _PLAIN.fullmatch(name):
        return None
    digits = name[len(PLAIN_PREFIX) + 1 :]
    return int(digits[0:2], 16), int(digits[2:4], 16), int(digits[4:6], 16)


def texture_file(name: str) -> str | None:
    """Return a picture's path below the wheel's ``miniworld/textures``, or None for a plain colour."""
    return None if name.startswith(PLAIN_PREFIX) else f"{name}.png"
