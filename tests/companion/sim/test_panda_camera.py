from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.guidance.coordinates import r_body_from_camera, r_from_euler
from companion.sim import panda_camera, textures
from companion.sim.panda_camera import PandaCamera, RenderQuality
from companion.sim.textures import SimulationExtraError, load_texture
from companion.sim.world.model import Box, Goal, Light, Opening, Picture, Start, Wall, World
from detector.camera_model import CameraModel

FORWARD = r_body_from_camera(0.0, 0.0, 0.0)
CAMERA = CameraModel.from_hfov(160, 120, 75.0)
OFF_CENTRE = CameraModel(160, 120, 110.0, 130.0, 90.0, 50.0)
BENT = CameraModel(160, 120, 105.0, 105.0, 82.0, 57.0, (-0.28, 0.09, 0.002, -0.001))
LENSES = [pytest.param(CAMERA, id="plain"), pytest.param(OFF_CENTRE, id="off centre")]
LENSES.append(pytest.param(BENT, id="distorted"))
SOUTH, NORTH, WEST, EAST, CEILING_M = -3.0, 7.0, -4.0, 5.0, 3.0
EYE = (0.3, -0.4, -1.3)
EVEN = Light(ambient=1.0)


def a_world(light: Light = EVEN, *, wall: str = "plain:#000000", boxes: tuple[Box, ...] = ()) -> World:
    corners = np.array([(SOUTH, WEST), (NORTH, WEST), (NORTH, EAST), (SOUTH, EAST)])
    walls = []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - begin) / np.linalg.norm(end - begin)
        outward = 0.05 * np.array(
            [along[1], -along[0]]
        )  # half the thickness: the inner faces meet in the corners
        walls.append(
            Wall(
                from_m=tuple((begin + outward - 0.1 * along).tolist()),
                to_m=tuple((end + outward + 0.1 * along).tolist()),
                thickness_m=0.1,
                texture=wall,
            )
        )
    return World(
        name="box",
        ceiling_m=CEILING_M,
        floor_texture="plain:#000000",
        ceiling_texture="plain:#000000",
        start=Start(north_m=0.0, east_m=0.0),
        goal=Goal(north_m=5.0, east_m=0.0),
        light=light,
        walls=tuple(walls),
        boxes=boxes,
    )


@pytest.fixture(scope="module")
def empty_room() -> Iterator[PandaCamera]:
    with PandaCamera(a_world()) as camera:
        yield camera


def true_depth_m(camera: CameraModel, rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where each pixel's ray leaves the room, along the camera's axis."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.pixel_to_ray(np.column_stack((x.ravel(), y.ravel())).astype(float))
    ned = rays @ rotation.T
    limits = np.array([[SOUTH, NORTH], [WEST, EAST], [-CEILING_M, 0.0]])
    with np.errstate(divide="ignore"):
        reach = np.where(ned > 0, limits[:, 1] - EYE, limits[:, 0] - EYE) / ned
    reach[ned == 0] = np.inf
    return np.asarray((reach.min(axis=1) * rays[:, 2]).reshape(y.shape))


@pytest.mark.parametrize("camera", LENSES)
@pytest.mark.parametrize("angles_deg", [(0, 0, 0), (0, 0, 90), (10, -15, 200), (-20, 25, -75)])
def test_depth_is_that_of_the_geometry(
    empty_room: PandaCamera, camera: CameraModel, angles_deg: tuple[float, float, float]
) -> None:
    rotation = r_from_euler(*np.radians(angles_deg)) @ FORWARD
    found, expected = empty_room.depth(camera, EYE, rotation), true_depth_m(camera, rotation)
    assert found.dtype == np.float32
    assert found.shape == expected.shape
    wrong = np.abs(found / expected - 1.0)
    # Through a bent lens a pixel's depth is taken up to 0.24 px beside it.
    assert wrong.max() < (5e-4 if not camera.is_distorted else 0.02)


def test_a_wall_met_squarely_has_one_depth(empty_room: PandaCamera) -> None:
    ahead = empty_room.depth(CAMERA, EYE, FORWARD)[50:70, 70:90]
    np.testing.assert_allclose(ahead, NORTH - EYE[0], atol=2e-3)


def edge_px(row: NDArray[np.uint8]) -> tuple[float, float]:
    """Left and right border of what is bright, where its share of the pixels says."""
    share = row.astype(float) / row.max()
    middle = int(np.argmax(share > 0.9)) + 2
    return middle - 0.5 - share[:middle].sum(), middle - 0.5 + share[middle:].sum()


@pytest.mark.parametrize("camera", LENSES)
def test_edges_are_seen_where_the_camera_model_puts_them(camera: CameraModel) -> None:
    near_north, west, east, top_m = 3.0, -0.9, 0.4, 2.0
    box = Box(
        centre_m=(near_north + 0.5, (west + east) / 2),
        size_m=(1.0, east - west, top_m),
        texture="plain:#ffffff",
    )
    rotation = r_from_euler(0.05, 0.03, -0.1) @ FORWARD
    with PandaCamera(a_world(boxes=(box,))) as eye:
        image = eye.render(camera, EYE, rotation)
    # Points along the front's two upright edges, at the heights that fall on whole rows.
    height = np.linspace(0.05, top_m - 0.05, 400)
    for east_m, side in ((west, 0), (east, 1)):
        places = np.column_stack((np.full(400, near_north), np.full(400, east_m), -height))
        pixels = camera.ray_to_pixel((places - EYE) @ rotation)
        rows = [row for row in range(20, 100, 7) if pixels[:, 1].min() < row < pixels[:, 1].max()]
        assert len(rows) >= 5
        for row in rows:
            expected_px = np.interp(row, pixels[::-1, 1], pixels[::-1, 0])
            assert edge_px(image[row])[side] == pytest.approx(expected_px, abs=0.25)


def test_a_side_edge_of_the_image_does_not_bend_a_straight_wall() -> None:
    rotation = r_from_euler(0.0, 0.0, np.radians(15.0)) @ FORWARD
    with PandaCamera(a_world()) as eye:
        straight = 1.0 / eye.depth(CAMERA, EYE, rotation)[60, 20:60].astype(np.float64)
    # One over depth is linear along a row on a plane.
    np.testing.assert_allclose(np.diff(straight, 2), 0.0, atol=1e-5)


def test_pictures_hang_the_right_way_round() -> None:
    portrait = Picture(
        at_m=4.4, side="right", width_m=2.0, height_m=2.0, bottom_m=0.3, texture="portraits/adelaide_hanscom1"
    )
    world = a_world()
    world = world.model_copy(
        update={
            "walls": tuple(wall.model_copy(update={"pictures": (portrait,)}) for wall in world.walls),
        }
    )
    camera = CameraModel.from_hfov(240, 240, 60.0)
    middle_east = WEST - 0.1 + 4.4
    with PandaCamera(world) as eye:
        image = eye.render(camera, (NORTH - 2.0, middle_east, -1.3), FORWARD)
    half = round(camera.fx_px * 0.5)  # 1 m to each side at 2 m
    import cv2

    seen = image[120 - half : 120 + half, 120 - half : 120 + half].astype(np.float64)
    painted = cv2.resize(load_texture(portrait.texture), seen.shape[::-1], interpolation=cv2.INTER_AREA)
    alike = [np.corrcoef(seen.ravel(), p.ravel())[0, 1] for p in (painted, painted[:, ::-1], painted[::-1])]
    assert alike[0] > 0.95
    assert alike[0] > max(alike[1:]) + 0.2


def test_a_doorway_can_be_looked_through() -> None:
    world = a_world()
    door = Wall(
        from_m=(3.0, WEST),
        to_m=(3.0, EAST),
        texture="plain:#ffffff",
        thickness_m=0.2,
        openings=(Opening(at_m=-WEST, width_m=1.0, height_m=2.1),),
    )
    world = world.model_copy(update={"walls": (*world.walls, door)})
    with PandaCamera(world) as eye:
        depth = eye.depth(CAMERA, (0.0, 0.0, -1.3), FORWARD)
    focal = CAMERA.fx_px
    assert depth[60, 80] == pytest.approx(NORTH, abs=0.01)
    assert depth[60, round(79.5 + 0.6 / 2.9 * focal)] == pytest.approx(2.9, abs=0.01)  # beside it
    assert depth[round(59.5 - 0.9 / 2.9 * focal), 80] == pytest.approx(2.9, abs=0.01)  # the lintel


def test_light_makes_surfaces_brighter() -> None:
    greys = {}
    for brightness in (0.5, 1.0, 2.0):
        with PandaCamera(a_world(Light(ambient=1.0, brightness=brightness), wall="plain:#505050")) as eye:
            greys[brightness] = eye.render(CAMERA, EYE, FORWARD)[60, 80]
    assert greys == {0.5: 40, 1.0: 80, 2.0: 160}


def test_light_from_one_side_parts_the_walls() -> None:
    light = Light(ambient=0.2, azimuth_deg=180.0, elevation_deg=0.0)  # from the south, upon what faces it
    with PandaCamera(a_world(light, wall="plain:#c8c8c8")) as eye:
        to_north = eye.render(CAMERA, EYE, FORWARD)[60, 80]
        to_south = eye.render(CAMERA, EYE, r_from_euler(0, 0, np.pi) @ FORWARD)[60, 80]
    assert 199 <= to_north <= 201
    assert 39 <= to_south <= 41


def test_one_camera_does_not_disturb_another() -> None:
    world = a_world(wall="brick_wall_1")
    first = PandaCamera(world)
    image = first.render(CAMERA, EYE, FORWARD)
    with PandaCamera(a_world(wall="wood_planks_1")) as second:
        assert (second.render(CAMERA, EYE, FORWARD) != image).any()
        np.testing.assert_array_equal(first.render(CAMERA, EYE, FORWARD), image)
    np.testing.assert_array_equal(first.render(CAMERA, EYE, FORWARD), image)
    first.depth(CAMERA, EYE, FORWARD)
    first.render(OFF_CENTRE, EYE, FORWARD)
    np.testing.assert_array_equal(first.render(CAMERA, EYE, FORWARD), image)
    first.close()
    with PandaCamera(world) as third:
        np.testing.assert_array_equal(third.render(CAMERA, EYE, FORWARD), image)


def test_cameras_that_are_closed_leave_nothing_behind() -> None:
    from panda3d import core

    def use_one() -> int:
        with PandaCamera(a_world(wall="brick_wall_1")) as eye:
            for north_m in np.linspace(0.0, 1.0, 20):
                eye.render(CAMERA, (north_m, 0.0, -1.0), FORWARD)
                eye.depth(CAMERA, (north_m, 0.0, -1.0), FORWARD)
        return int(core.RenderState.get_num_states()) + int(core.TransformState.get_num_states())

    first = use_one()
    assert max(use_one() for _ in range(3)) <= first + 5


def test_a_closed_camera_says_so() -> None:
    eye = PandaCamera(a_world())
    eye.close()
    eye.close()
    with pytest.raises(RuntimeError, match="closed"):
        eye.render(CAMERA, EYE, FORWARD)


def test_another_process_gets_the_same_pixels() -> None:
    code = "from tests.companion.sim.test_panda_camera import digest; print(digest())"
    other = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert other.stdout.strip() == digest()
    assert other.stderr == ""


def digest() -> str:
    """What two processes compare."""
    box = Box(centre_m=(3.0, 0.7), size_m=(0.8, 0.5, 1.1), yaw_deg=25.0)
    with PandaCamera(a_world(Light(), wall="brick_wall_1", boxes=(box,))) as eye:
        rotation = r_from_euler(0.05, -0.04, 0.2) @ FORWARD
        parts = eye.render(BENT, EYE, rotation), eye.depth(BENT, EYE, rotation)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_more_samples_come_nearer_to_the_truth() -> None:
    with PandaCamera(a_world(wall="brick_wall_1"), quality=RenderQuality(4, 16, 0.0)) as best:
        reference = best.render(CAMERA, EYE, FORWARD).astype(np.float64)
    errors = []
    for quality in (RenderQuality(1, 1, 0.0), RenderQuality()):
        with PandaCamera(a_world(wall="brick_wall_1"), quality=quality) as eye:
            errors.append(float(np.sqrt(np.mean((eye.render(CAMERA, EYE, FORWARD) - reference) ** 2))))
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("quality", [{"supersample": 0}, {"anisotropy": 32}, {"lod_bias": -9.0}])
def test_a_quality_out_of_range_is_refused(quality: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(quality))):
        RenderQuality(**quality)


def test_a_pose_of_the_wrong_shape_is_refused(empty_room: PandaCamera) -> None:
    with pytest.raises(ValueError, match="expected a position"):
        empty_room.render(CAMERA, (0.0, 0.0), FORWARD)


def test_without_egl_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    panda_camera._headless_pipe.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(panda_camera, "_LIBRARIES", ("libEGL-that-is-not-there.so.1",))
        with pytest.raises(
            SimulationExtraError, match=r"apt-get install --no-install-recommends libegl1 libgl1"
        ):
            PandaCamera(a_world())


def test_without_its_pictures_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(textures.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulationExtraError, match=r"void-companion\[sim\]"):
        load_texture("brick_wall_1")


def test_the_command_line_starts_without_the_renderer() -> None:
    code = (
        "import sys, companion.cli, companion.sim.panda_camera;"
        "sys.exit(any(m.split('.')[0] in ('panda3d', 'direct', 'miniworld') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
