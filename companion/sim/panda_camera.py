"""A camera in a world, rendered by Panda3D without window, display or GPU: grey images, and true depth.

The pipe is ``p3headlessgl``: EGL on Mesa's software rasteriser. The same pose gives the same pixels. A picture is
rendered at twice its size and averaged, its textures sharpened by one level: nearer to a picture averaged from 16 or
36 samples a pixel than four-fold multisampling with anisotropic textures is, in half the time
(``benchmarks/render_cost.py``). Depth is rendered on its own, at the pixels' centres, and only when it is asked for.

Panda3D is imported inside the functions: it is part of the extra ``sim``.
"""

from __future__ import annotations

import ctypes
import functools
import math
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from companion.sim.panda_world import scene_graph
from companion.sim.textures import SimulationExtraError
from companion.sim.world.model import World
from companion.sim.world_surfaces import world_surfaces
from detector.camera_model import CameraModel

_NEAR_M: Final = 0.03
_FAR_M: Final = 300.0
_BACKGROUND_GREY: Final = 0.25
_LARGEST_SIDE_PX: Final = 8192
_LIBRARIES: Final = ("libEGL.so.1", "libGL.so.1")


@dataclass(frozen=True, slots=True)
class RenderQuality:
    """How much is spent on a picture.

    Attributes
    ----------
    supersample
        Samples a pixel and axis, 1 to 4.
    anisotropy
        Samples of a texture along its slant, 1 to 16; far slower than ``supersample`` for what it gives.
    lod_bias
        On the level of the smaller copies of the textures; -1 suits ``supersample`` 2.
    """

    supersample: int = 2
    anisotropy: int = 1
    lod_bias: float = -1.0

    def __post_init__(self) -> None:
        for name, most in (("supersample", 4), ("anisotropy", 16)):
            value = getattr(self, name)
            if not 1 <= value <= most:
                raise ValueError(f"{name} must be from 1 to {most}, got {value}")
        if not -4.0 <= self.lod_bias <= 4.0:
            raise ValueError(f"lod_bias must be from -4 to 4, got {self.lod_bias}")


class PandaCamera:
    """Looks at a world; satisfies ``companion.sim.camera_feed.Renderer``. Used by the thread that made it, and by no other.

    Parameters
    ----------
    world
        What there is to be seen.
    quality
        Of the pictures.

    Raises
    ------
    companion.sim.textures.SimulationExtraError
        When Panda3D, the pictures of the world or the system's graphics libraries are missing.
    """

    def __init__(self, world: World, *, quality: RenderQuality | None = None) -> None:
        self._quality = quality if quality is not None else RenderQuality()
        self._pipe = _headless_pipe()
        from panda3d import core

        self._engine = core.GraphicsEngine(self._pipe)
        self._root: Any = scene_graph(
            world_surfaces(world),
            world.light,
            anisotropy=self._quality.anisotropy,
            lod_bias=self._quality.lod_bias,
        )
        self._images: dict[tuple[CameraModel, int], _Buffer] = {}
        self._depths: dict[CameraModel, _Buffer] = {}
        self._host: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give buffers and pictures back. The camera cannot be used afterwards."""
        if self._root is None:
            return
        self._images.clear()
        self._depths.clear()
        self._host = None
        self._engine.remove_all_windows()
        for texture in self._root.find_all_textures():
            texture.clear()  # states that Panda3D keeps for reuse would keep the pictures too
        self._root = None
        _forget_unused_states()

    def render(
        self,
        camera: CameraModel,
        position_ned_m: ArrayLike,
        r_ned_from_camera: ArrayLike,
        *,
        supersample: int | None = None,
        shift_px: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.uint8]:
        """Give the grey image that a camera takes.

        Parameters
        ----------
        camera
            Its size and lens.
        position_ned_m
            (3,), local NED.
        r_ned_from_camera
            (3, 3), camera frame (x right, y down, z forward) to local NED.
        supersample
            Instead of the quality's.
        shift_px
            Move the samples by this much, x and y, of a pixel: for pictures averaged from several.

        Returns
        -------
        (height_px, width_px) uint8.
        """
        samples = supersample if supersample is not None else self._quality.supersample
        buffer = self._images.get((camera, samples))
        if buffer is None:
            view = _View(camera, samples)
            buffer = _Buffer(self._engine, self._host_buffer(), self._root, view, depth=False)
            self._images[(camera, samples)] = buffer
        pixels = buffer.render(self._engine, position_ned_m, r_ned_from_camera, shift_px)
        large = buffer.view.through_lens(pixels, cv2.INTER_LINEAR)
        if samples == 1:
            return np.ascontiguousarray(large)
        size = (camera.width_px, camera.height_px)
        return np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def depth(
        self, camera: CameraModel, position_ned_m: ArrayLike, r_ned_from_camera: ArrayLike
    ) -> NDArray[np.float32]:
        """Give the true depth of each pixel's centre, along the camera's axis.

        Through a lens with distortion it is that of the nearest ray of a picture without, at most 0.24 px away.

        Returns
        -------
        (height_px, width_px), metres; infinite where there is nothing.
        """
        buffer = self._depths.get(camera)
        if buffer is None:
            view = _View(camera, 3 if camera.is_distorted else 1)
            buffer = _Buffer(self._engine, self._host_buffer(), self._root, view, depth=True)
            self._depths[camera] = buffer
        stored = buffer.render(self._engine, position_ned_m, r_ned_from_camera, (0.0, 0.0))
        # Inverse of z_stored = f (z - n) / (z (f - n)).
        metres = _NEAR_M * _FAR_M / (_FAR_M - stored.astype(np.float64) * (_FAR_M - _NEAR_M))
        metres[stored >= 1.0] = math.inf
        return np.ascontiguousarray(buffer.view.depth_through_lens(metres), dtype=np.float32)

    def _host_buffer(self) -> Any:
        """Return the small buffer whose graphics context all others share; made when first needed."""
        if self._root is None:
            raise RuntimeError("the camera is closed")
        if self._host is None:
            self._host = _made(self._engine, self._pipe, "host", (1, 1), None)
            self._host.set_active(False)
        return self._host


class _View:
    """The pinhole picture that is rendered for a camera, and how the camera's lens bends it.

    ``samples`` to a pixel and axis. Without distortion the pinhole picture is the camera's own; with it, it is as
    large as the camera's outermost rays ask for, with the camera's resolution in the middle.
    """

    def __init__(self, camera: CameraModel, samples: int) -> None:
        width, height = camera.width_px * samples, camera.height_px * samples
        fine = camera.scaled_to(width, height)
        self.fx_px, self.fy_px, self.cx_px, self.cy_px = fine.fx_px, fine.fy_px, fine.cx_px, fine.cy_px
        self.width_px, self.height_px = width, height
        self.samples = samples
        self._map: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if not camera.is_distorted:
            return
        x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        rays = fine.pixel_to_ray(np.column_stack((x.ravel(), y.ravel())))
        flat = rays[:, :2] / rays[:, 2:3]
        low, high = flat.min(axis=0), flat.max(axis=0)
        # Two samples beyond the outermost rays, for the interpolation.
        self.cx_px, self.cy_px = 2.0 - low[0] * self.fx_px, 2.0 - low[1] * self.fy_px
        self.width_px = min(math.ceil((high[0] - low[0]) * self.fx_px) + 5, _LARGEST_SIDE_PX)
        self.height_px = min(math.ceil((high[1] - low[1]) * self.fy_px) + 5, _LARGEST_SIDE_PX)
        self._map = (
            (flat[:, 0] * self.fx_px + self.cx_px).reshape(height, width).astype(np.float32),
            (flat[:, 1] * self.fy_px + self.cy_px).reshape(height, width).astype(np.float32),
        )

    def through_lens(self, pixels: NDArray[np.uint8], interpolation: int) -> NDArray[np.uint8]:
        """Return the camera's picture, still ``samples`` times as large."""
        if self._map is None:
            return pixels
        return np.asarray(cv2.remap(pixels, *self._map, interpolation), dtype=np.uint8)

    def depth_through_lens(self, metres: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depth at the camera's pixels' centres."""
        if self._map is None:
            return metres
        # The sample nearest to a pixel's centre; mixing depths across an edge would invent places.
        columns, rows = (
            np.rint(m[self.samples // 2 :: self.samples, self.samples // 2 :: self.samples]).astype(np.intp)
            for m in self._map
        )
        nearest = metres[rows.clip(0, metres.shape[0] - 1), columns.clip(0, metres.shape[1] - 1)]
        return np.asarray(nearest, dtype=np.float64)


class _Buffer:
    """An offscreen buffer with a lens, in the context of a host; it renders only when it is told to."""

    def __init__(self, engine: Any, host: Any, root: Any, view: _View, *, depth: bool) -> None:
        from panda3d import core

        self.view = view
        self._depth = depth
        size = (view.width_px, view.height_px)
        self._buffer = _made(engine, host.get_gsg().get_pipe(), "depth" if depth else "image", size, host)
        self._texture = core.Texture("read back")
        plane = core.GraphicsOutput.RTP_depth if depth else core.GraphicsOutput.RTP_color
        self._buffer.add_render_texture(self._texture, core.GraphicsOutput.RTM_copy_ram, plane)
        self._buffer.set_clear_color((_BACKGROUND_GREY, _BACKGROUND_GREY, _BACKGROUND_GREY, 1.0))
        self._buffer.set_active(False)
        # Sides of the film at distance 1: the pinhole's own figures.
        self._lens = core.PerspectiveLens()
        self._lens.set_near_far(_NEAR_M, _FAR_M)
        self._lens.set_film_size(view.width_px / view.fx_px, view.height_px / view.fy_px)
        self._lens.set_focal_length(1.0)
        camera = core.Camera("camera", self._lens)
        self._camera = core.NodePath(camera)
        self._camera.reparent_to(root)
        self._buffer.make_display_region().set_camera(self._camera)
        if depth:  # nothing but the shape of things
            state = core.NodePath("depth only")
            state.set_texture_off(1)
            state.set_color(1.0, 1.0, 1.0, 1.0, 1)
            camera.set_initial_state(state.get_state())

    def render(
        self,
        engine: Any,
        position_ned_m: ArrayLike,
        r_ned_from_camera: ArrayLike,
        shift_px: tuple[float, float],
    ) -> NDArray[Any]:
        from panda3d import core

        position = np.asarray(position_ned_m, dtype=np.float64)
        rotation = np.asarray(r_ned_from_camera, dtype=np.float64)
        if position.shape != (3,) or rotation.shape != (3, 3):
            raise ValueError(
                f"expected a position (3,) and a rotation (3, 3), got {position.shape} and {rotation.shape}"
            )
        # Panda3D's camera has x right, y forward, z up; its matrices multiply rows from the left.
        right, down, forward = rotation.T
        rows = [*zip(right, forward, -down, position, strict=True)]
        matrix = np.zeros((4, 4))
        matrix[:, :3] = np.array(rows).T
        matrix[3, 3] = 1.0
        self._camera.set_mat(core.LMatrix4(*matrix.ravel().tolist()))
        view = self.view
        offset_x_px = view.cx_px - 0.5 * (view.width_px - 1) - shift_px[0] * view.samples
        offset_y_px = view.cy_px - 0.5 * (view.height_px - 1) - shift_px[1] * view.samples
        self._lens.set_film_offset(-offset_x_px / view.fx_px, offset_y_px / view.fy_px)
        self._buffer.set_active(True)
        try:
            engine.render_frame()
        finally:
            self._buffer.set_active(False)
        _forget_unused_states()
        data = self._texture.get_ram_image()
        if not data:
            raise SimulationExtraError(
                "the graphics library gave no picture back; is Mesa's driver installed?"
            )
        kind = np.dtype(np.float32) if self._depth else np.dtype(np.uint8)
        pixels = np.frombuffer(data, dtype=kind).reshape(view.height_px, view.width_px, -1)
        return pixels[::-1, :, 0]


def _made(engine: Any, pipe: Any, name: str, size: tuple[int, int], host: Any) -> Any:
    from panda3d import core

    wanted = core.FrameBufferProperties()
    wanted.set_rgba_bits(8, 8, 8, 0)
    wanted.set_depth_bits(24)
    shape = core.WindowProperties(size=size)
    flags = core.GraphicsPipe.BF_refuse_window
    sharing = () if host is None else (host.get_gsg(), host)
    buffer = engine.make_output(pipe, name, 0, wanted, shape, flags, *sharing)
    if buffer is None:
        raise SimulationExtraError(
            f"EGL gives no offscreen buffer of {size[0]} x {size[1]} pixels: {_install_hint()}"
        )
    return buffer


def _forget_unused_states() -> None:
    """Free states and transforms that nobody uses: Panda3D leaves that to a task of the framework that is not used here."""
    from panda3d import core

    core.RenderState.garbage_collect()
    core.TransformState.garbage_collect()


@functools.cache
def _headless_pipe() -> Any:
    """Return this process's one way to the graphics library; a second one that ends would end the first one's display."""
    for library in _LIBRARIES:
        try:
            ctypes.CDLL(library)
        except OSError as error:
            raise SimulationExtraError(f"{library} is missing: {_install_hint()}") from error
    try:
        from panda3d import core
    except ImportError as error:
        raise SimulationExtraError(
            f"the renderer cannot be loaded ({error}): pip install 'void-companion[sim]'"
        ) from error
    # It warns that there is no display, which is how it is meant.
    core.Notify.ptr().get_category(":display:egldisplay").set_severity(core.NS_error)
    pipe = core.GraphicsPipeSelection.get_global_ptr().make_module_pipe("p3headlessgl")
    if pipe is None or not pipe.is_valid():
        raise SimulationExtraError(f"EGL cannot be used: {_install_hint()}")
    return pipe


def _install_hint() -> str:
    return "on Debian or Ubuntu: apt-get install --no-install-recommends libegl1 libgl1"
