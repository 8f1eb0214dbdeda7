"""A world as a scene graph of Panda3D: one geometry a texture, its light already in the colours of the vertices.

Panda3D is imported inside the functions: it is part of the extra ``sim``.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.sim.surfaces import Surface
from companion.sim.textures import load_texture
from companion.sim.world.model import Light

_VERTEX = np.dtype([("position", "<f4", 3), ("colour", "u1", 4), ("uv", "<f4", 2)])
_BRIGHTEST: Final = 2.0
"""Colours of vertices end at 1, light at twice that: colours are halved, and the texture stage doubles."""


def light_on(surface: Surface, light: Light) -> NDArray[np.float64]:
    """Return the light on each vertex, (N,): 1 leaves the texture as it is."""
    azimuth, elevation = math.radians(light.azimuth_deg), math.radians(light.elevation_deg)
    level = math.cos(elevation)
    towards = np.array([level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation)])
    facing = np.clip(surface.normal_ned.astype(np.float64) @ towards, 0.0, None)
    return np.asarray(light.brightness * (light.ambient + (1.0 - light.ambient) * facing))


def scene_graph(
    surfaces: Sequence[Surface], light: Light, *, anisotropy: int = 1, lod_bias: float = 0.0
) -> Any:
    """Make a scene graph.

    Parameters
    ----------
    surfaces
        What is to be seen.
    light
        On it.
    anisotropy
        Samples of a texture along its slant, 1 to 16: more is sharper on floors far away, and slower.
    lod_bias
        Added to the level of the smaller copies of a texture; negative is sharper.

    Returns
    -------
    ``panda3d.core.NodePath``, its coordinates local NED.
    """
    from panda3d import core

    root = core.NodePath("world")
    by_texture: defaultdict[str, list[Surface]] = defaultdict(list)
    for surface in surfaces:
        by_texture[surface.texture].append(surface)
    stage = core.TextureStage("lit")
    stage.set_combine_rgb(
        core.TextureStage.CM_modulate,
        core.TextureStage.CS_texture,
        core.TextureStage.CO_src_color,
        core.TextureStage.CS_primary_color,
        core.TextureStage.CO_src_color,
    )
    stage.set_rgb_scale(int(_BRIGHTEST))
    for order, (name, parts) in enumerate(by_texture.items()):
        node = core.GeomNode(name)
        node.add_geom(_geom(parts, light))
        path = root.attach_new_node(node)
        path.set_texture(stage, _texture(name, anisotropy, lod_bias))
        path.set_two_sided(True)
        # By default the order depends on addresses in memory, and with it who wins where two things meet.
        path.set_bin("fixed", order)
    return root


def _geom(parts: Sequence[Surface], light: Light) -> Any:
    from panda3d import core

    offsets = np.cumsum([0, *(len(part.position_ned_m) for part in parts)])
    vertices = np.zeros(int(offsets[-1]), dtype=_VERTEX)
    vertices["position"] = np.concatenate([part.position_ned_m for part in parts])
    vertices["uv"] = np.concatenate([part.uv for part in parts])
    shade = np.concatenate([part.grey * light_on(part, light) for part in parts])
    colour = np.clip(np.rint(255.0 / _BRIGHTEST * shade), 0, 255).astype(np.uint8)
    vertices["colour"] = np.column_stack((colour, colour, colour, np.full_like(colour, 255)))
    triangles = np.concatenate(
        [part.triangles + np.uint32(offset) for part, offset in zip(parts, offsets[:-1], strict=True)]
    ).astype("<u4")
    layout = core.GeomVertexFormat.get_v3c4t2()
    data = core.GeomVertexData("surfaces", layout, core.Geom.UH_static)
    data.unclean_set_num_rows(len(vertices))
    memoryview(data.modify_array(0)).cast("B")[:] = vertices.tobytes()
    primitive = core.GeomTriangles(core.Geom.UH_static)
    primitive.set_index_type(core.Geom.NT_uint32)
    index = primitive.modify_vertices()
    index.unclean_set_num_rows(triangles.size)
    memoryview(index).cast("B")[:] = triangles.tobytes()
    geom = core.Geom(data)
    geom.add_primitive(primitive)
    return geom


def _texture(name: str, anisotropy: int, lod_bias: float) -> Any:
    from panda3d import core

    grey = load_texture(name)
    height, width = grey.shape
    texture = core.Texture(name)
    texture.setup_2d_texture(width, height, core.Texture.T_unsigned_byte, core.Texture.F_luminance)
    texture.set_auto_texture_scale(core.ATS_none)
    texture.set_ram_image(np.ascontiguousarray(grey[::-1]).tobytes())  # its first row is the lowest
    sampler = core.SamplerState()
    sampler.set_minfilter(core.SamplerState.FT_linear_mipmap_linear)
    sampler.set_magfilter(core.SamplerState.FT_linear)
    sampler.set_wrap_u(core.SamplerState.WM_repeat)
    sampler.set_wrap_v(core.SamplerState.WM_repeat)
    sampler.set_anisotropic_degree(anisotropy)
    sampler.set_lod_bias(lod_bias)
    texture.set_default_sampler(sampler)
    return texture
