"""One answer against all the truth there is about its pair. Pure functions; docs/evaluation.md gives the rules in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from detector.camera_model import CameraModel
from detector.evaluation.dataset import Box, Motion, Pair, Truth
from detector.evaluation.methods import NONE, SINGLE_PLANE, Answer

NEAR_SHARE: Final = 0.1
"""Of the width: as near as this to a vanishing point counts as right (Meurisse's rule, and that of published figures)."""
DEEP_SHARE: Final = 0.9
"""Of the greatest depth: a column as deep as this is a right answer; a flat optimum has many."""
WALL_LIMIT_M: Final = 3.0
"""Where the best free distance lies below it, a wall is ahead, if nothing else says whether one is."""
_WALL_LIMIT_BAND_M: Final = 0.3
"""As near to the limit as this, "wall" and "free" are the same to a vehicle."""
_NEARLY_STEPS: Final = 6
"""Of half a degree, to either side."""
_CHANCE_COLUMNS: Final = 180
_MIN_FORWARD_M: Final = 0.01
"""With less motion along the axis there is no time to contact to compare with."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What an answer is judged against.

    Attributes
    ----------
    truth
        About the pair, at the instant of its later frame.
    image_size_px
        Width and height.
    camera
        None where it is not known.
    motion
        Of the camera between the two frames; None where it is not known.
    focus_px
        True focus of expansion in the earlier frame.
    earlier_contact_s, later_contact_s
        True time to contact at the two frames.
    turned_back
        Whether the later image was turned into the orientation of the earlier one.
    """

    truth: Truth
    image_size_px: tuple[int, int]
    camera: CameraModel | None = None
    motion: Motion | None = None
    focus_px: tuple[float, float] | None = None
    earlier_contact_s: float | None = None
    later_contact_s: float | None = None
    turned_back: bool = False


@dataclass(frozen=True, slots=True)
class Verdict:
    """An answer and what is right about it. None where the truth does not say, or where there is nothing to judge.

    Attributes
    ----------
    a, b
        The pair's files.
    kind, reason
        Of the answer.
    x_px, y_px, width_px
        The direction, in the later frame as it was taken, and the width of that.
    has_direction_truth
        Whether a direction could be judged.
    right, in_box, error_width, error_deg, profile_ratio
        Of a direction: right by any rule; inside a box; its distance from the true point as a share of the width and as an angle;
        the depth of its column over that of the deepest one.
    nearly_right
        Whether it, or a direction within three degrees to its left or right, is right.
    chance
        Share of the columns that would be right, in the row where most of the truth lies: what guessing would reach.
    single_plane_truth, no_motion_truth
        What the scene is.
    near_wall_limit
        Whether the freest way ends within 0.3 m of the wall limit.
    foe_px
        Distance of the estimated focus of expansion from the true one, in the earlier frame.
    contact_frames, contact_truth_frames, contact_source, contact_error
        Time to contact in steps of the pair's length, where the true one comes from, and the relative error.
    valid_frac
        Share of the later frame whose depth is known.
    baseline_m, rotation_deg
        Between the frames.
    seconds
        That the answer took.
    wall_ahead
        Whether nothing is free beyond the wall limit, by the free distances alone; None where they are not known, or end near the limit.
    """

    a: str
    b: str
    kind: str
    reason: str | None
    x_px: float | None
    y_px: float | None
    width_px: int
    has_direction_truth: bool
    right: bool | None
    nearly_right: bool | None
    in_box: bool | None
    error_width: float | None
    error_deg: float | None
    profile_ratio: float | None
    chance: float | None
    single_plane_truth: bool | None
    near_wall_limit: bool
    no_motion_truth: bool | None
    foe_px: float | None
    contact_frames: float | None
    contact_truth_frames: float | None
    contact_source: str | None
    contact_error: float | None
    valid_frac: float | None
    baseline_m: float | None
    rotation_deg: float | None
    seconds: float
    wall_ahead: bool | None = None

    @property
    def is_direction(self) -> bool:
        """Whether the answer is a direction."""
        return self.kind not in (SINGLE_PLANE, NONE)


@dataclass(frozen=True, slots=True)
class LineVerdict:
    """The line stage on one frame with a known vanishing point.

    Attributes
    ----------
    frame
        The file.
    x_px, y_px
        What was found; None where nothing was.
    error_width
        Distance from the truth as a share of the width.
    within_tenth_width
        Whether it is right; false where nothing was found.
    seconds
        That it took.
    """

    frame: str
    x_px: float | None
    y_px: float | None
    error_width: float | None
    within_tenth_width: bool
    seconds: float


def judge(answer: Answer, pair: Pair, scene: Scene, seconds: float) -> Verdict:
    """Return what is right about an answer.

    Parameters
    ----------
    answer
        Of a method; its points lie in the later image that the method saw.
    pair
        Which pair.
    scene
        What is known.
    seconds
        That the answer took.
    """
    point = None if answer.point_px is None else _in_frame_b(answer.point_px, scene)
    ratio = None if point is None else profile_ratio(scene.truth, point[0], scene.image_size_px[0])
    error_width, error_deg = (None, None) if point is None else _error(point, scene)
    in_box = None if point is None else _in_boxes(point, scene.truth)
    contact_truth = _contact_truth(answer, point, scene)
    contact_error = None
    if contact_truth is not None and answer.contact_frames is not None:
        contact_error = abs(answer.contact_frames - contact_truth[0]) / contact_truth[0]
    motion, depth = scene.motion, scene.truth.depth
    return Verdict(
        a=pair.a,
        b=pair.b,
        kind=answer.kind,
        reason=answer.reason,
        x_px=None if point is None else point[0],
        y_px=None if point is None else point[1],
        width_px=scene.image_size_px[0],
        has_direction_truth=has_direction_truth(scene.truth),
        right=None if point is None else is_right(point, scene),
        nearly_right=None if point is None else is_nearly_right(point, scene),
        in_box=in_box,
        error_width=error_width,
        error_deg=error_deg,
        profile_ratio=ratio,
        chance=chance_right(scene),
        single_plane_truth=is_single_plane(scene.truth),
        near_wall_limit=_near_wall_limit(scene.truth),
        no_motion_truth=scene.truth.no_motion,
        foe_px=_focus_error_px(answer, scene),
        contact_frames=answer.contact_frames,
        contact_truth_frames=None if contact_truth is None else contact_truth[0],
        contact_source=None if contact_truth is None else contact_truth[1],
        contact_error=contact_error,
        valid_frac=None if depth is None else depth.valid_frac,
        baseline_m=None if motion is None else motion.baseline_m,
        rotation_deg=None if motion is None else math.degrees(motion.rotation_rad),
        seconds=seconds,
        wall_ahead=_wall_ahead(scene.truth),
    )


def judge_lines(
    frame: str,
    found_px: tuple[float, float] | None,
    true_px: tuple[float, float],
    width_px: int,
    seconds: float,
) -> LineVerdict:
    """Return what is right about a vanishing point that the line stage found, or did not find."""
    if found_px is None:
        return LineVerdict(frame, None, None, None, within_tenth_width=False, seconds=seconds)
    error = math.dist(found_px, true_px) / width_px
    return LineVerdict(
        frame, *found_px, error_width=error, within_tenth_width=error <= NEAR_SHARE, seconds=seconds
    )


def is_right_answer(verdict: Verdict) -> bool | None:
    """Return whether an answer of any kind is right; None where the truth does not say, and for silence, which is neither.

    Without motion silence alone is right. "Single plane" is right before one; a direction where :func:`is_right` says so, else, where
    only a plane is known of, it is wrong.
    """
    if verdict.no_motion_truth:
        return verdict.kind == NONE
    if verdict.kind == NONE:
        return None
    if verdict.kind == SINGLE_PLANE:
        return None if verdict.near_wall_limit else verdict.single_plane_truth
    if verdict.right is None and verdict.single_plane_truth:
        return False
    return verdict.right


def is_single_plane(truth: Truth) -> bool | None:
    """Return whether a plane or wall fills the view: true where any mark says so, None where no mark says anything."""
    depth = truth.depth
    # A still's wall_close names what closes the view.
    close = True if isinstance(truth.wall_close, str) else truth.wall_close
    marks = [truth.single_plane, close, truth.wall_ahead]
    marks.append(None if depth is None else depth.plane_like)
    if truth.wall_ahead is None and truth.best_free_distance_m is not None:
        marks.append(truth.best_free_distance_m < WALL_LIMIT_M)
    known = [mark for mark in marks if mark is not None]
    return any(known) if known else None


def has_direction_truth(truth: Truth) -> bool:
    """Return whether a direction can be called right or wrong."""
    return truth.vp is not None or bool(_boxes(truth)) or _deepest_m(truth) is not None


def profile_ratio(truth: Truth, x_px: float, width_px: int) -> float | None:
    """Return how far a direction's column is free over the freest one's (:func:`_profile_m`); None where that is not known."""
    deepest_m = _deepest_m(truth)
    at_m = _column_m(_profile_m(truth), x_px, width_px)
    return None if deepest_m is None or at_m is None else at_m / deepest_m


def is_right(point: tuple[float, float], scene: Scene) -> bool | None:
    """Return whether a direction is right by any of the rules; None where the truth does not say."""
    truth = scene.truth
    if not has_direction_truth(truth):
        return None
    near = truth.vp is not None and math.dist(point, truth.vp) <= NEAR_SHARE * scene.image_size_px[0]
    ratio = profile_ratio(truth, point[0], scene.image_size_px[0])
    deep = ratio is not None and ratio >= DEEP_SHARE  # a column whose depth is not known is not right
    return near or deep or bool(_in_boxes(point, truth))


def is_nearly_right(point: tuple[float, float], scene: Scene) -> bool | None:
    """Return whether a direction is right, or one within three degrees to its left or right is; None where the truth or the camera does not say."""
    found = is_right(point, scene)
    camera = scene.camera
    if found is None or found or camera is None:
        return found
    at_rad = math.atan((point[0] - camera.cx_px) / camera.fx_px)
    beside_px = [
        camera.cx_px + camera.fx_px * math.tan(at_rad + math.radians(0.5 * step))
        for step in range(-_NEARLY_STEPS, _NEARLY_STEPS + 1)
    ]
    return any(
        is_right((x_px, point[1]), scene) for x_px in beside_px if 0.0 <= x_px <= scene.image_size_px[0] - 1
    )


def _near_wall_limit(truth: Truth) -> bool:
    """Return whether the freest direction ends so near to the wall limit that neither answer is wrong."""
    best_m = truth.best_free_distance_m
    return best_m is not None and abs(best_m - WALL_LIMIT_M) <= _WALL_LIMIT_BAND_M


def _wall_ahead(truth: Truth) -> bool | None:
    best_m = truth.best_free_distance_m
    return None if best_m is None or _near_wall_limit(truth) else best_m < WALL_LIMIT_M


def chance_right(scene: Scene) -> float | None:
    """Return which share of the columns would be right, in the row of the vanishing point, of a box, or of the middle."""
    truth, (width_px, height_px) = scene.truth, scene.image_size_px
    boxes = _boxes(truth)
    row_px = 0.5 * (height_px - 1)
    if truth.vp is not None:
        row_px = truth.vp[1]
    elif boxes:
        row_px = 0.5 * (boxes[0][1] + boxes[0][3])
    columns = [(index + 0.5) / _CHANCE_COLUMNS * width_px - 0.5 for index in range(_CHANCE_COLUMNS)]
    found = [is_right((x_px, row_px), scene) for x_px in columns]
    return None if None in found else sum(map(bool, found)) / _CHANCE_COLUMNS


# ---------------------------------------------------------------------- direction


def _error(point: tuple[float, float], scene: Scene) -> tuple[float | None, float | None]:
    """Return the distance from the true point: the vanishing point, else across the image alone, the deepest column or a box's middle."""
    truth, camera = scene.truth, scene.camera
    width_px = scene.image_size_px[0]
    if truth.vp is not None:
        error_px, target = math.dist(point, truth.vp), truth.vp
    else:
        x_px = _target_x_px(truth)
        if x_px is None:
            return None, None
        error_px = abs(point[0] - x_px)
        row_px = point[1] if camera is None else camera.cy_px
        point, target = (point[0], row_px), (x_px, row_px)
    if camera is None:
        return error_px / width_px, None
    first, second = camera.pixel_to_ray([point, target])
    angle_rad = math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second))
    return error_px / width_px, math.degrees(angle_rad) if math.isfinite(angle_rad) else None


def _target_x_px(truth: Truth) -> float | None:
    if truth.depth is not None and truth.depth.free_column is not None:
        return truth.depth.free_column.x
    boxes = _boxes(truth)
    return 0.5 * (boxes[0][0] + boxes[0][2]) if boxes else None


def _boxes(truth: Truth) -> list[Box]:
    return [box for box in (truth.far_box, truth.doorway_box) if box is not None]


def _in_boxes(point: tuple[float, float], truth: Truth) -> bool | None:
    boxes = _boxes(truth)
    if not boxes:
        return None
    return any(x0 <= point[0] <= x1 and y0 <= point[1] <= y1 for x0, y0, x1, y1 in boxes)


def _profile_m(truth: Truth) -> tuple[float | None, ...]:
    """Return how far the way is free by columns: for the vehicle where a world says so, else to what is seen there."""
    if truth.free_distance_profile_m:
        return truth.free_distance_profile_m
    return _depths_m(truth)


def _depths_m(truth: Truth) -> tuple[float | None, ...]:
    return (None if truth.depth is None else truth.depth.column_profile_m) or ()


def _deepest_m(truth: Truth) -> float | None:
    known = [free_m for free_m in _profile_m(truth) if free_m is not None and free_m > 0.0]
    return max(known) if known else None


def _column_m(profile: tuple[float | None, ...], x_px: float, width_px: int) -> float | None:
    if not profile:
        return None
    # Pixel centres have whole coordinates: the image reaches from -0.5 to width - 0.5.
    column = math.floor((x_px + 0.5) / width_px * len(profile))
    return profile[column] if 0 <= column < len(profile) else None


def _in_frame_b(point_px: tuple[float, float], scene: Scene) -> tuple[float, float]:
    """Return a point of the image that the method saw in the later frame as it was taken."""
    if not scene.turned_back or scene.camera is None or scene.motion is None:
        return point_px
    ray = scene.camera.pixel_to_ray([point_px])[0]
    x, y = scene.camera.ray_to_pixel([scene.motion.later_from_earlier @ ray])[0]
    return (float(x), float(y)) if math.isfinite(x) else point_px


# ---------------------------------------------------------------------- motion


def _focus_error_px(answer: Answer, scene: Scene) -> float | None:
    if answer.focus_px is None or scene.focus_px is None:
        return None
    focus = answer.focus_px
    if scene.camera is not None and scene.motion is not None and not scene.turned_back:
        # The focus belongs to the image without distortion of the later frame, the truth to that of the earlier one.
        camera = scene.camera
        ray = np.linalg.solve(camera.matrix, np.array([*focus, 1.0]))
        turned = camera.matrix @ scene.motion.later_from_earlier.T @ ray
        if not turned[2] > 1e-6:
            return None
        focus = (float(turned[0] / turned[2]), float(turned[1] / turned[2]))
    return math.dist(focus, scene.focus_px)


def _contact_truth(
    answer: Answer, point: tuple[float, float] | None, scene: Scene
) -> tuple[float, str] | None:
    """Return the true time to contact in steps of the pair's length, and where it comes from."""
    earlier_s, later_s = scene.earlier_contact_s, scene.later_contact_s
    if earlier_s is not None and later_s is not None:
        step_s = earlier_s - later_s
        return (later_s / step_s, "time_to_contact_s") if step_s > 0.0 and later_s > 0.0 else None
    if scene.motion is None:
        return None
    forward_m = float(scene.motion.translation_later_m[2])
    if forward_m < _MIN_FORWARD_M:
        return None
    depth = scene.truth.depth
    if answer.kind == SINGLE_PLANE:
        plane = None if depth is None or not depth.plane_like else depth.plane
        if plane is None or not plane.dist_m > 0.0 or not plane.normal_vs_axis_deg < 60.0:
            return None
        along_axis_m = plane.dist_m / math.cos(math.radians(plane.normal_vs_axis_deg))
        return along_axis_m / forward_m, "plane"
    at_m = None if point is None else _column_m(_depths_m(scene.truth), point[0], scene.image_size_px[0])
    return None if at_m is None or at_m <= 0.0 else (at_m / forward_m, "column_profile_m")
