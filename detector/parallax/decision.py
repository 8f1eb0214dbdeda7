"""The answer to a pair: a wall, a gap of the void map, or nothing known.

Two tests make a wall, and they are not the same: one plane fills the view and comes nearer; or, in metres, nothing is free beyond the wall limit whatever
its shape. "Nothing known" is neither: unknown is not free, and it is no wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from detector.parallax.params import ParallaxParams
from detector.parallax.plane import distance_along_axis_m, plane_is_wall
from detector.parallax.ranges import contact_about
from detector.parallax.void_map import BINS, Gap, VoidMap, VoidMapParams, bin_of, choose_gap, void_map
from detector.results import (
    Detection,
    Diagnostics,
    Direction,
    DirectionKind,
    NoDetection,
    NoDetectionReason,
    SinglePlane,
    TimeToContact,
)

if TYPE_CHECKING:
    from detector.parallax.pipeline import PairGeometry

SINGLE_PLANE: Final = "single_plane"
GAP: Final = "gap"
NONE: Final = "none"

_CONTACT_GATE_RAD: Final = math.radians(5.0)
_FACING: Final = math.cos(math.radians(60.0))
_BEYOND: Final = 1.3
_ELEVATION_STEP_RAD: Final = math.radians(1.0)


@dataclass(frozen=True, slots=True)
class Decision:
    """What the map says.

    Attributes
    ----------
    void_map
        Free distance by azimuth.
    kind
        ``single_plane``, ``gap`` or ``none``.
    gap
        In the level frame; None where the answer is another.
    point_px
        The gap's direction in the later frame.
    time_to_contact
        Of the wall, or along the gap.
    detail
        Figures, for people.
    """

    void_map: VoidMap
    kind: str
    gap: Gap | None = None
    point_px: tuple[float, float] | None = None
    time_to_contact: TimeToContact | None = None
    confidence: float | None = None
    detail: str = ""

    def answer(self, diagnostics: Diagnostics) -> Detection:
        """Return the decision as a detection."""
        if self.kind == SINGLE_PLANE:
            return SinglePlane(self.time_to_contact, diagnostics, self.confidence)
        if self.kind == GAP and self.point_px is not None:
            return Direction(
                *self.point_px, DirectionKind.GAP, self.time_to_contact, diagnostics, self.confidence
            )
        return NoDetection(NoDetectionReason.NOTHING_KNOWN, self.detail, diagnostics)


def decide(
    geometry: PairGeometry,
    params: ParallaxParams,
    map_params: VoidMapParams,
    *,
    wanted_rad: float | None = None,
) -> Decision:
    """Return the answer of one pair's map and plane.

    Parameters
    ----------
    geometry
        Of the pair.
    params, map_params
        Settings.
    wanted_rad
        The planner's direction in the level frame, for ``least_deviation``.
    """
    assumed_m = params.assumed_baseline_m
    unit_m = 1.0 if geometry.samples.metric else assumed_m
    found = void_map(geometry.samples, map_params, baseline_m=assumed_m)
    return decide_on(geometry, found, unit_m, params, map_params, wanted_rad=wanted_rad)


def decide_on(
    geometry: PairGeometry,
    found: VoidMap,
    unit_m: float,
    params: ParallaxParams,
    map_params: VoidMapParams,
    *,
    wanted_rad: float | None = None,
) -> Decision:
    """Return the answer of a map, of this pair alone or remembered, and this pair's plane.

    Parameters
    ----------
    geometry, params, map_params, wanted_rad
        As :func:`decide` has them.
    found
        The map.
    unit_m
        Metres that its unit stands for.
    """
    gap = choose_gap(_in_picture(geometry, found), map_params, wanted_rad=wanted_rad, unit_m=unit_m)
    in_metres = found.metric and geometry.is_level
    if in_metres and gap is not None:
        # Where the free distances themselves are known they say what a wall is: along a slanted one there may be far to go.
        if float(found.free_m[found.known].max()) < params.wall_limit_m:
            return Decision(found, SINGLE_PLANE, time_to_contact=_nearest_contact(geometry))
    else:
        wall = _plane_ahead(geometry, params)
        if wall is not None and (gap is None or not _is_beyond(geometry, gap)):
            return Decision(found, SINGLE_PLANE, time_to_contact=wall)
    if gap is None:
        return Decision(found, NONE, detail="no direction in view has samples enough")
    ray, point_px = _seen_at(geometry, gap.azimuth_rad)
    if point_px is None:
        return Decision(found, NONE, detail="the free direction lies outside the picture")
    contact = contact_about(geometry.depths, geometry.motion, ray, _CONTACT_GATE_RAD)
    return Decision(found, GAP, gap, point_px, contact)


def _in_picture(geometry: PairGeometry, found: VoidMap) -> VoidMap:
    """Return the map of the directions that the picture shows: those beside it are known by what lies next to them, but cannot be pointed at."""
    rays = geometry.samples.rays_level
    shown = np.zeros(BINS, np.bool_)
    shown[bin_of(np.arctan2(rays[:, 1], rays[:, 0]))] = True
    return found.where(shown)


def _plane_ahead(geometry: PairGeometry, params: ParallaxParams) -> TimeToContact | None:
    """Return the time to contact of the plane that fills the view; None where there is none."""
    plane = geometry.plane
    if plane is None or not plane_is_wall(plane, params):
        return None
    normal = plane.normal_later
    if normal is not None and abs(float(normal[2])) < _FACING:
        return None  # a floor, or a wall that one flies along
    if geometry.baseline_m is not None:
        distance_m = distance_along_axis_m(plane, geometry.motion, geometry.baseline_m)
        if distance_m is not None and distance_m > params.wall_limit_m:
            return None  # far enough to fly on: the map says where
    return plane.contact


def _is_beyond(geometry: PairGeometry, gap: Gap) -> bool:
    """Return whether a gap reaches further than the plane that explains most of the view: a wall with a way past it."""
    plane, motion = geometry.plane, geometry.motion
    if plane is None or plane.normal_later is None or plane.contact is None:
        return False
    ray = np.array([math.cos(gap.azimuth_rad), math.sin(gap.azimuth_rad), 0.0]) @ geometry.frame_from_later
    towards = float(plane.normal_later @ ray)
    if towards < 1e-3:
        return True
    unit_m = 1.0 if geometry.baseline_m is None else geometry.baseline_m
    to_plane = plane.contact.frames * float(plane.normal_later @ motion.direction_later) / towards * unit_m
    return gap.free_m > _BEYOND * to_plane


def _nearest_contact(geometry: PairGeometry) -> TimeToContact | None:
    axis = np.array([0.0, 0.0, 1.0])
    return contact_about(geometry.depths, geometry.motion, axis, 3.0 * _CONTACT_GATE_RAD)


def _seen_at(
    geometry: PairGeometry, azimuth_rad: float
) -> tuple[NDArray[np.float64], tuple[float, float] | None]:
    """Return the ray of an azimuth in the later camera and its pixel: level where the picture holds that, else the nearest elevation that it holds."""
    steps = np.arange(-60, 61) * _ELEVATION_STEP_RAD
    steps = steps[np.argsort(np.abs(steps), kind="stable")]
    rays = np.column_stack(
        [np.cos(azimuth_rad) * np.cos(steps), np.sin(azimuth_rad) * np.cos(steps), -np.sin(steps)]
    )
    rays = rays @ geometry.frame_from_later
    points = geometry.camera.ray_to_pixel(rays)
    camera = geometry.camera
    inside = (points[:, 0] >= 0) & (points[:, 0] <= camera.width_px - 1)
    inside &= (points[:, 1] >= 0) & (points[:, 1] <= camera.height_px - 1)
    if not inside.any():
        return rays[0], None
    index = int(np.flatnonzero(inside)[0])
    return rays[index], (float(points[index, 0]), float(points[index, 1]))
