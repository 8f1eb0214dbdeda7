"""Sets of images with what is known about them: ``groundtruth.json``, a walk with poses, or a grid of robot positions.

The names of the fields are those of the files (docs/evaluation.md describes the layout). Points are x, y in px of the full
image; poses are camera to world in metres, camera x right, y down, z forward. Images are read by who uses them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from detector.camera_model import CameraError, CameraModel

TRUTH_FILE: Final = "groundtruth.json"
POSES_FILE: Final = "poses.json"

Finite = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite]
Box = tuple[Finite, Finite, Finite, Finite]
_Row4 = tuple[Finite, Finite, Finite, Finite]
_Row3 = tuple[Finite, Finite, Finite]

_ROTATION_TOLERANCE: Final = 1e-2
"""Files hold rounded figures: R transpose(R) may differ from the identity by this much."""

_MIN_FORWARD_SHARE: Final = 0.02
"""Of the baseline: with less of it along the axis the focus of expansion lies next to infinitely far outside."""

_UPRIGHT: Final = math.cos(math.radians(40.0))

_GAP_M: Final = 0.25
"""A partner that lies further than it has to by this much, and by the baseline, stands across a gap in the sequence."""


class DatasetError(ValueError):
    """A set of images cannot be used; the message is one line that names the file, the key and what was found."""


class _Read(BaseModel):
    """What is read from a file; keys that are not known here are left alone, files hold measurements of other tools too."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class FreeColumn(_Read):
    """Middle of the deepest columns of an image."""

    x: Finite
    depth_m: Finite | None = None


class Plane(_Read):
    """The plane that holds most of a depth image."""

    dist_m: Finite
    normal_vs_axis_deg: Finite


class Depth(_Read):
    """What a depth image says: ``column_profile_m`` is the depth of equally wide columns, None where it is not known."""

    valid_frac: Annotated[float, Field(ge=0, le=1)] | None = None
    column_profile_m: tuple[Finite | None, ...] | None = None
    free_column: FreeColumn | None = None
    plane: Plane | None = None
    plane_like: bool | None = None


class Truth(_Read):
    """What is known about a frame or a pair; None where it is not.

    ``wall_close`` also comes as the name of what closes the view; ``free_distance_profile_m`` is how far the vehicle could fly in the direction of
    equally wide columns, and goes before the depth of those columns, which knows nothing of the vehicle's size.
    """

    vp: Point | None = None
    far_box: Box | None = None
    doorway_box: Box | None = None
    single_plane: bool | None = None
    wall_close: bool | str | None = None
    wall_ahead: bool | None = None
    best_free_distance_m: Annotated[float, Field(ge=0)] | None = None
    free_distance_profile_m: tuple[Annotated[float, Field(ge=0)] | None, ...] | None = None
    no_motion: bool | None = None
    time_to_contact_s: Finite | None = None
    depth: Depth | None = None


class Frame(Truth):
    """A frame, with its pose where that is known."""

    pose: tuple[_Row4, _Row4, _Row4, _Row4] | None = None

    @field_validator("pose")
    @classmethod
    def _rigid(cls, pose: tuple[_Row4, ...] | None) -> tuple[_Row4, ...] | None:
        if pose is not None:
            rotation = np.array(pose)[:3, :3]
            off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
            if not off <= _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
                raise ValueError("is not a pose: its upper left 3 x 3 is not a rotation")
        return pose


class Pair(Truth):
    """Two frames of one camera that moved. What is said of a pair goes before what is said of its later frame.

    ``b_derot`` is the later frame turned back into the orientation of the earlier one; ``foe`` lies in frame ``a``.
    """

    a: str
    b: str
    b_derot: str | None = None
    foe: Point | None = None


class _File(_Read):
    name: str | None = None
    image_size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    K: tuple[_Row3, _Row3, _Row3] | None = None
    distortion: tuple[Finite, ...] | str | None = None
    frames: dict[str, Frame]
    pairs: tuple[Pair, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _frames_by_name(cls, table: Any) -> Any:
        # A walk lists its frames in order, each with its file.
        if isinstance(table, Mapping) and isinstance(table.get("frames"), Sequence):
            named: dict[str, Any] = {}
            for index, item in enumerate(table["frames"]):
                if not isinstance(item, Mapping) or not isinstance(item.get("file"), str):
                    raise ValueError(f"frames.{index}: found no file name under 'file'")  # noqa: TRY004 - pydantic reports a ValueError by its key
                named[item["file"]] = item
            return {**table, "frames": named}
        return table

    @model_validator(mode="after")
    def _pairs_are_of_frames(self) -> Self:
        for index, pair in enumerate(self.pairs):
            for key, name in (("a", pair.a), ("b", pair.b)):
                if name not in self.frames:
                    raise ValueError(f"pairs.{index}.{key}: found {name!r}, which is not among the frames")
        return self


@dataclass(frozen=True, slots=True)
class Motion:
    """How the camera moved between the frames of a pair.

    Attributes
    ----------
    later_from_earlier
        (3, 3) rotation that takes coordinates of the earlier camera to those of the later one.
    translation_earlier_m
        (3,) from the earlier to the later position, in the earlier camera's axes.
    """

    later_from_earlier: NDArray[np.float64]
    translation_earlier_m: NDArray[np.float64]

    @property
    def baseline_m(self) -> float:
        """Metres between the two positions."""
        return float(np.linalg.norm(self.translation_earlier_m))

    @property
    def rotation_rad(self) -> float:
        """Angle of the rotation."""
        rotation = self.later_from_earlier
        skew = (rotation - rotation.T)[[2, 0, 1], [1, 2, 0]]
        # By sine and cosine: the arc cosine alone makes a degree of the rounding of small turns.
        return math.atan2(0.5 * float(np.linalg.norm(skew)), 0.5 * (float(np.trace(rotation)) - 1.0))

    @property
    def translation_later_m(self) -> NDArray[np.float64]:
        """(3,) the translation in the later camera's axes."""
        translation: NDArray[np.float64] = self.later_from_earlier @ self.translation_earlier_m
        return translation


@dataclass(frozen=True, slots=True)
class ImageSet:
    """A folder of images and what is known about them.

    Attributes
    ----------
    name
        For people.
    folder
        What the file names in ``frames`` and ``pairs`` are relative to.
    image_size_px
        Width and height; None where no file says it.
    camera
        Where K is known.
    frames
        By file name, in the order of the file.
    pairs
        Those that the file names; see :func:`pairs_by_baseline` for others.
    """

    name: str
    folder: Path
    image_size_px: tuple[int, int] | None
    camera: CameraModel | None
    frames: Mapping[str, Frame]
    pairs: tuple[Pair, ...] = field(default=())

    @property
    def has_poses(self) -> bool:
        """Whether every frame has its pose."""
        return bool(self.frames) and all(frame.pose is not None for frame in self.frames.values())

    def truth_of(self, pair: Pair) -> Truth:
        """Return what is known at the instant of a pair's later frame, which is what an answer refers to."""
        frame = self.frames[pair.b]
        known = {
            key: getattr(pair, key) if getattr(pair, key) is not None else getattr(frame, key)
            for key in Truth.model_fields
        }
        return Truth.model_construct(**known)

    def motion_of(self, pair: Pair) -> Motion | None:
        """Return how the camera moved; None where a pose is not known."""
        earlier, later = self.frames[pair.a].pose, self.frames[pair.b].pose
        if earlier is None or later is None:
            return None
        world_a, world_b = np.array(earlier, np.float64), np.array(later, np.float64)
        moved_m = world_b[:3, 3] - world_a[:3, 3]
        return Motion(world_b[:3, :3].T @ world_a[:3, :3], world_a[:3, :3].T @ moved_m)

    def level_from_later(self, pair: Pair) -> NDArray[np.float64] | None:
        """Return the rotation (3, 3) from a pair's later camera to a level frame with its z axis down; None where it is not known."""
        pose, level_from_world = self.frames[pair.b].pose, self.level_from_world()
        if pose is None or level_from_world is None:
            return None
        rotation: NDArray[np.float64] = level_from_world @ np.array(pose, np.float64)[:3, :3]
        return rotation

    def level_from_world(self) -> NDArray[np.float64] | None:
        """Return the rotation (3, 3) from the poses' world to a level frame with its z axis down; None where no pose is known.

        Files do not say which way of their world is up. It is taken to be the axis of that world that the cameras' own vertical axes lie nearest to
        on average; None too where they lie near none (more than 40 degrees).
        """
        poses = [frame.pose for frame in self.frames.values() if frame.pose is not None]
        if not poses:
            return None
        below = np.mean([np.array(each, np.float64)[:3, 1] for each in poses], axis=0)
        axis = int(np.argmax(np.abs(below)))
        if abs(below[axis]) < _UPRIGHT * float(np.linalg.norm(below)):
            return None
        down, ahead = np.zeros(3), np.zeros(3)
        down[axis], ahead[(axis + 1) % 3] = np.sign(below[axis]), 1.0
        return np.asarray(np.stack([ahead, np.cross(down, ahead), down]), np.float64)

    def focus_of(self, pair: Pair) -> tuple[float, float] | None:
        """Return the true focus of expansion in a pair's earlier frame: the file's, else that of the poses.

        It belongs to the image without distortion. None where neither is known, and where the camera did not move forwards.
        """
        if pair.foe is not None:
            return pair.foe
        motion = self.motion_of(pair)
        if motion is None or self.camera is None:
            return None
        x_m, y_m, z_m = (float(value) for value in motion.translation_earlier_m)
        if z_m <= _MIN_FORWARD_SHARE * motion.baseline_m:
            return None
        camera = self.camera
        return camera.cx_px + camera.fx_px * x_m / z_m, camera.cy_px + camera.fy_px * y_m / z_m


def load_truth(path: Path) -> ImageSet:
    """Read ``groundtruth.json``, or the ``poses.json`` of a walk, which holds frames in order and no pairs.

    Raises
    ------
    DatasetError
        The file cannot be read, is not JSON, or a key is missing or cannot be used.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: is not text in UTF-8") from error
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: is not valid JSON: {error}") from error
    if not isinstance(table, dict):
        raise DatasetError(f"{path}: found a {type(table).__name__}, needed is an object with frames")
    try:
        file = _File.model_validate(table)
    except ValidationError as error:
        raise DatasetError(f"{path}: {_explain(error)}") from error
    try:
        camera = _camera(file)
    except CameraError as error:
        raise DatasetError(f"{path}: K: {error}") from error
    return ImageSet(
        file.name or path.parent.name, path.parent, file.image_size, camera, file.frames, file.pairs
    )


def with_truth_of(images: ImageSet, other: ImageSet) -> ImageSet:
    """Return a set with what another set knows about frames of the same file name, where the first does not know it itself.

    A walk and the set of its labelled frames go together so.

    Raises
    ------
    DatasetError
        No frame stands in both.
    """
    shared = images.frames.keys() & other.frames.keys()
    if not shared:
        raise DatasetError(f"{other.folder}: has no frame of the same name as one of {images.folder}")
    frames: dict[str, Frame] = {}
    for name, frame in images.frames.items():
        known = other.frames.get(name, frame)
        missing = {key: getattr(known, key) for key in Frame.model_fields if getattr(frame, key) is None}
        frames[name] = frame.model_copy(update=missing)
    return replace(images, frames=frames)


def pairs_by_baseline(
    images: ImageSet, min_baseline_m: float, *, max_rotation_rad: float = math.radians(18.0)
) -> tuple[Pair, ...]:
    """Form pairs from the poses of a sequence.

    Each frame is paired with the latest earlier one that lies at least the baseline away, as the observer would. Left out are frames whose
    partner lies more than twice as far away and more than 0.25 m further (a gap in the sequence), or was turned by more than
    ``max_rotation_rad`` (too little is seen in both).

    Parameters
    ----------
    images
        Its frames in order, each with its pose.
    min_baseline_m
        Least distance between the two camera positions.
    max_rotation_rad
        Between the two.

    Raises
    ------
    DatasetError
        A frame has no pose.
    """
    if not images.has_poses:
        raise DatasetError(f"{images.folder}: a least baseline needs the pose of every frame")
    names = list(images.frames)
    positions_m = np.array([[row[3] for row in images.frames[name].pose or ()][:3] for name in names])
    found: list[Pair] = []
    for index in range(1, len(names)):
        away_m = np.linalg.norm(positions_m[:index] - positions_m[index], axis=1)
        far = np.flatnonzero(away_m >= min_baseline_m)
        if not far.size or away_m[far[-1]] > min_baseline_m + max(min_baseline_m, _GAP_M):
            continue
        pair = Pair(a=names[int(far[-1])], b=names[index])
        motion = images.motion_of(pair)
        if motion is not None and motion.rotation_rad <= max_rotation_rad:
            found.append(pair)
    return tuple(found)


def _camera(file: _File) -> CameraModel | None:
    if file.K is None:
        return None
    # In words ("none") where there is none.
    distortion = () if file.distortion is None or isinstance(file.distortion, str) else file.distortion
    (fx, _, cx), (_, fy, cy), _ = file.K
    return CameraModel(*file.image_size, fx, fy, cx, cy, tuple(distortion))


def _explain(error: ValidationError) -> str:
    first, *others = error.errors()
    where = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    what = "missing" if first["type"] == "missing" else message[0].lower() + message[1:]
    found = "" if first["type"] in ("missing", "value_error") else f" (found {_short(first['input'])})"
    more = f"; and {len(others)} more like it" if others else ""
    return f"{where}: {what}{found}{more}" if where else f"{what}{more}"


def _short(value: object, limit: int = 60) -> str:
    text = repr(value)
    return text if len(text) <= limit else f"{text[:limit]}..."
