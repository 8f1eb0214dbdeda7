"""The layers of furniture hold what is rendered, and little more."""

import math

import numpy as np
import pytest

from companion.sim.textures import SimulationExtraError, miniworld_folder
from companion.sim.wavefront import load_mesh
from companion.sim.world.furniture import MESHES
from companion.sim.world.furniture_layers import LAYERS
from companion.sim.world.model import Furniture
from companion.sim.world.prisms import _furniture_prisms


@pytest.mark.parametrize("kind", sorted(LAYERS))
def test_every_corner_of_the_mesh_lies_in_its_layer(kind: str) -> None:
    try:
        folder = miniworld_folder()
    except SimulationExtraError as error:
        pytest.skip(str(error))
    mesh = MESHES[kind]  # type: ignore[index]  # a kind of furniture, as the table's keys are
    assert mesh.file is not None
    low, high = np.array(mesh.low), np.array(mesh.high)
    parts = load_mesh(folder / "meshes", mesh.file.removesuffix(".obj"))
    corners = np.concatenate([part.position_ned_m for part in parts])
    along, across = (
        (corners[:, axis] - 0.5 * (low[axis] + high[axis])) * mesh.metres_per_unit for axis in (0, 2)
    )
    above = (corners[:, 1] - low[1]) * mesh.metres_per_unit
    held = np.zeros(len(corners), bool)
    for bottom_m, top_m, outline in LAYERS[kind]:
        ends = np.array(outline)
        sides = np.roll(ends, -1, axis=0) - ends
        here = (above >= bottom_m - 0.01) & (above <= top_m + 0.01)
        inside = np.ones(len(corners), bool)
        for (x, z), (dx, dz) in zip(ends, sides, strict=True):
            # Clockwise as seen from above: inside is to the right of each side.
            inside &= (across - z) * dx - (along - x) * dz >= -0.02 * math.hypot(dx, dz)
        held |= here & inside
    assert held.all()
    assert LAYERS[kind][0][0] == 0.0
    assert LAYERS[kind][-1][1] == pytest.approx(mesh.height_m, abs=0.01)


def test_a_turned_and_scaled_desk_has_its_monitor_where_it_is_drawn() -> None:
    desk = Furniture(kind="desk", centre_m=(2.0, 3.0), yaw_deg=90.0, scale=2.0)
    lower, upper = _furniture_prisms(desk)
    assert (lower.bottom_m, lower.top_m, upper.top_m) == pytest.approx((0.0, 1.6, 2.4))
    # The monitor stands at the end behind the heading, which is west of the middle now.
    np.testing.assert_allclose(upper.outline_m[:, 1].max(), 3.0 - 2.0 * 0.32, atol=1e-9)
    np.testing.assert_allclose(lower.outline_m[:, 1].max(), 3.0 + 2.0 * 0.63, atol=1e-9)
