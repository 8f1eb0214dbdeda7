"""Run a method over a set of images with known truth, and sum up how it did.

Nothing is read here: images come through a function that is passed in.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from detector.evaluation.bootstrap import share_interval
from detector.evaluation.dataset import DatasetError, ImageSet, Pair
from detector.evaluation.judgement import LineVerdict, Scene, Verdict, judge, judge_lines
from detector.evaluation.methods import METHODS, NONE, SINGLE_PLANE, Method, PairInput, with_focus
from detector.params import DetectorParams, PresetName

Poses = Literal["full", "rotation", "none"]
ReadImage = Callable[[Path], NDArray[np.uint8]]

POSES: Final[tuple[Poses, ...]] = ("full", "rotation", "none")
_IMAGES_KEPT: Final = 4


@dataclass(frozen=True, slots=True)
class Settings:
    """What is evaluated.

    Attributes
    ----------
    method
        A name in :data:`detector.evaluation.methods.METHODS`, or of a method made elsewhere.
    preset
        What the parameters started from.
    params
        The parameters.
    poses
        What a method is told of the motion where it is known: rotation and translation, the rotation alone, or nothing.
    derotated
        The later image is the one turned back into the orientation of the earlier one.
    sequence
        Only the first pair of a set is a first loop; else every pair is, and p, n and k are estimated anew.
    """

    method: str
    preset: PresetName
    params: DetectorParams
    poses: Poses = "full"
    derotated: bool = False
    sequence: bool = False

    @property
    def changes(self) -> dict[str, Any]:
        """The parameters that are not the preset's."""
        usual = DetectorParams.preset(self.preset).model_dump()
        return {key: value for key, value in self.params.model_dump().items() if value != usual[key]}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What came out for one set."""

    images: ImageSet
    settings: Settings
    verdicts: tuple[Verdict, ...]
    line_verdicts: tuple[LineVerdict, ...]


def evaluate(
    images: ImageSet,
    pairs: Sequence[Pair],
    settings: Settings,
    read_image: ReadImage,
    *,
    method: Method | None = None,
    on_step: Callable[[], None] | None = None,
    timer: Callable[[], float] = time.perf_counter,
) -> Evaluation:
    """Judge a method on pairs of a set, and its line stage on every frame with a known vanishing point.

    Parameters
    ----------
    images
        The set.
    pairs
        Of it. Where there are none, the line stage is judged on all frames of the set, else on the pairs' later frames.
    settings
        What is evaluated.
    read_image
        Gives (H, W) uint8 of a file.
    method
        Made elsewhere, in place of the one that the settings name.
    on_step
        Called after each of the :func:`count_steps` steps.
    timer
        Gives seconds.

    Raises
    ------
    DatasetError
        Images derotated are asked for and a pair has none, or an image has another size than the set says.
    """
    if settings.derotated:
        for pair in pairs:
            if pair.b_derot is None:
                raise DatasetError(f"{images.folder}: the pair of {pair.a} and {pair.b} has no b_derot")
    if method is None:
        method = METHODS[settings.method](settings.params)
    reader = _Reader(images, read_image)
    verdicts: list[Verdict] = []
    for pair in pairs:
        verdicts.append(_judge_pair(images, pair, settings, method, reader, timer))
        if on_step is not None:
            on_step()
    line_verdicts: list[LineVerdict] = []
    for name in _line_frames(images, pairs):
        image, true_px = reader.read(name), images.frames[name].vp
        if true_px is not None:
            begin = timer()
            found_px = method.vanishing_point(image)
            seconds = timer() - begin
            line_verdicts.append(judge_lines(name, found_px, true_px, image.shape[1], seconds))
        if on_step is not None:
            on_step()
    return Evaluation(images, settings, tuple(verdicts), tuple(line_verdicts))


def count_steps(images: ImageSet, pairs: Sequence[Pair]) -> int:
    """Return how many steps :func:`evaluate` takes, for a progress bar."""
    return len(pairs) + len(_line_frames(images, pairs))


def enough_depth(images: ImageSet, pairs: Iterable[Pair], min_valid_frac: float) -> tuple[Pair, ...]:
    """Return the pairs without those whose later frame has a depth image of which less than this share is known.

    Pairs without any depth image stay: their truth is of another kind.
    """

    def is_enough(pair: Pair) -> bool:
        depth = images.truth_of(pair).depth
        return depth is None or depth.valid_frac is None or depth.valid_frac >= min_valid_frac

    return tuple(pair for pair in pairs if is_enough(pair))


def scene_of(
    images: ImageSet, pair: Pair, image_size_px: tuple[int, int], *, turned_back: bool = False
) -> Scene:
    """Return what an answer to a pair of a set is judged against.

    Parameters
    ----------
    images, pair
        Which.
    image_size_px
        Width and height.
    turned_back
        Whether the later image was turned into the orientation of the earlier one.
    """
    return Scene(
        truth=images.truth_of(pair),
        image_size_px=image_size_px,
        camera=images.camera,
        motion=images.motion_of(pair),
        focus_px=images.focus_of(pair),
        earlier_contact_s=images.frames[pair.a].time_to_contact_s,
        later_contact_s=images.frames[pair.b].time_to_contact_s,
        turned_back=turned_back,
    )


def summary(evaluation: Evaluation, *, seed: int = 0) -> dict[str, Any]:
    """Return the figures of one set as plain values (the keys of ``detector evaluate --json``, docs/evaluation.md).

    Parameters
    ----------
    evaluation
        Of the set.
    seed
        Of the bootstrap intervals.
    """
    verdicts, settings = evaluation.verdicts, evaluation.settings
    camera_known = evaluation.images.camera is not None
    told: Poses = (
        settings.poses if camera_known and any(v.baseline_m is not None for v in verdicts) else "none"
    )
    return {
        "name": evaluation.images.name,
        "method": settings.method,
        "preset": settings.preset,
        "changes": settings.changes,
        "images": "derotated" if settings.derotated else "as_taken",
        "poses": told,
        "loops": "sequence" if settings.sequence else "first",
        "pairs": len(verdicts),
        "kinds": _counts(v.kind for v in verdicts),
        "reasons": _counts(v.reason for v in verdicts if v.reason is not None),
        "direction": _direction(verdicts, seed),
        "foe": _foe(verdicts),
        "single_plane": _single_plane(verdicts, seed),
        "no_motion": _no_motion(verdicts),
        "vanishing_point": _vanishing_point(evaluation.line_verdicts, seed),
        "time_to_contact": _contact(verdicts),
        "seconds": _seconds(verdicts),
        "per_pair": [dataclasses.asdict(v) for v in verdicts],
        "per_frame": [dataclasses.asdict(v) for v in evaluation.line_verdicts],
    }


# ---------------------------------------------------------------------- running


class _Reader:
    """Reads images of a set, keeps the newest few (the next pair often shares one) and checks their size."""

    def __init__(self, images: ImageSet, read_image: ReadImage) -> None:
        self._images = images
        self._read_image = read_image
        self._kept: dict[str, NDArray[np.uint8]] = {}

    def read(self, name: str) -> NDArray[np.uint8]:
        if name not in self._kept:
            path = self._images.folder / name
            image, size = self._read_image(path), self._images.image_size_px
            found = (image.shape[1], image.shape[0])
            if size is not None and found != size:
                raise DatasetError(
                    f"{path}: found {found[0]} x {found[1]} px, image_size says {size[0]} x {size[1]}"
                )
            while len(self._kept) >= _IMAGES_KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[name] = image
        return self._kept[name]


def _judge_pair(
    images: ImageSet,
    pair: Pair,
    settings: Settings,
    method: Method,
    reader: _Reader,
    timer: Callable[[], float],
) -> Verdict:
    turned_back = pair.b_derot if settings.derotated else None
    earlier, later = reader.read(pair.a), reader.read(pair.b if turned_back is None else turned_back)
    motion = images.motion_of(pair)
    rotation = translation_m = level = None
    if motion is not None and images.camera is not None and settings.poses != "none":
        rotation = np.eye(3) if settings.derotated else motion.later_from_earlier
        translation_m = motion.translation_earlier_m if settings.poses == "full" else None
        level = images.level_from_later(pair)
        if settings.derotated and level is not None:
            level = (
                level @ motion.later_from_earlier
            )  # the later picture was turned into the earlier orientation
    if not settings.sequence:
        method.reset()
    begin = timer()
    answer = method.answer(PairInput(earlier, later, images.camera, rotation, translation_m, level))
    seconds = timer() - begin
    scene = scene_of(images, pair, (later.shape[1], later.shape[0]), turned_back=settings.derotated)
    return judge(with_focus(answer, images.camera), pair, scene, seconds)


def _line_frames(images: ImageSet, pairs: Sequence[Pair]) -> list[str]:
    names = dict.fromkeys(pair.b for pair in pairs) if pairs else images.frames
    return [name for name in names if images.frames[name].vp is not None]


# ---------------------------------------------------------------------- summing up


def _direction(verdicts: Sequence[Verdict], seed: int) -> dict[str, Any]:
    answered = [v for v in verdicts if v.is_direction]
    judged = [v for v in answered if v.right is not None]
    open_ = [v for v in judged if v.single_plane_truth is not True]
    return {
        "answered": len(answered),
        "with_truth": len(judged),
        "right": sum(v.right is True for v in judged),
        "right_ci": _ci(judged, lambda v: v.right is True, seed),
        "chance": _mean(v.chance for v in judged),
        "in_box": sum(v.in_box is True for v in judged),
        "within_tenth_width": sum(v.error_width is not None and v.error_width <= 0.1 for v in judged),
        "median_error_width": _median(v.error_width for v in judged),
        "median_error_deg": _median(v.error_deg for v in judged),
        "median_profile_ratio": _median(v.profile_ratio for v in judged),
        "open_with_truth": len(open_),
        "open_right": sum(v.right is True for v in open_),
        "open_right_ci": _ci(open_, lambda v: v.right is True, seed),
        "open_nearly_right": sum(v.nearly_right is True for v in open_),
        "pairs_with_truth": sum(v.has_direction_truth for v in verdicts),
    }


def _foe(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    errors = [v.foe_px for v in verdicts if v.foe_px is not None]
    return {"n": len(errors), "median_px": _median(errors)}


def _single_plane(verdicts: Sequence[Verdict], seed: int) -> dict[str, Any]:
    walls = [v for v in verdicts if v.single_plane_truth is True]
    open_ = [v for v in verdicts if v.single_plane_truth is False]
    tp = sum(v.kind == SINGLE_PLANE for v in walls)
    fp = sum(v.kind == SINGLE_PLANE for v in open_)
    clear = [(v.kind == SINGLE_PLANE, v.wall_ahead) for v in verdicts if v.wall_ahead is not None]
    return {
        "tp": tp,
        "fp": fp,
        "fn": len(walls) - tp,
        "tn": len(open_) - fp,
        "silent_on_planes": sum(v.kind == NONE for v in walls),
        "silent_elsewhere": sum(v.kind == NONE for v in open_),
        "found_ci": _ci(walls, lambda v: v.kind == SINGLE_PLANE, seed),
        "false_ci": _ci(open_, lambda v: v.kind == SINGLE_PLANE, seed),
        "clear_tp": sum(said and true for said, true in clear),
        "clear_fp": sum(said and not true for said, true in clear),
        "clear_fn": sum(not said and true for said, true in clear),
        "clear_tn": sum(not said and not true for said, true in clear),
    }


def _no_motion(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    still = [v for v in verdicts if v.no_motion_truth is True]
    return {"with_truth": len(still), "silent": sum(v.kind == NONE for v in still)}


def _vanishing_point(verdicts: Sequence[LineVerdict], seed: int) -> dict[str, Any]:
    hits = np.array([v.within_tenth_width for v in verdicts], np.bool_)
    return {
        "with_truth": len(verdicts),
        "found": sum(v.x_px is not None for v in verdicts),
        "within_tenth_width": int(hits.sum()),
        "within_tenth_width_ci": share_interval(hits, seed=seed),
        "median_error_width": _median(v.error_width for v in verdicts),
        "median_seconds": _median(v.seconds for v in verdicts),
    }


def _contact(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    judged = [v for v in verdicts if v.contact_error is not None]
    return {
        "n": len(judged),
        "median_relative_error": _median(v.contact_error for v in judged),
        "sources": _counts(v.contact_source for v in judged if v.contact_source is not None),
    }


def _seconds(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    taken = [v.seconds for v in verdicts]
    return {"median": _median(taken), "p95": float(np.percentile(taken, 95)) if taken else None}


def _ci(cases: Sequence[Verdict], is_hit: Callable[[Verdict], bool], seed: int) -> tuple[float, float] | None:
    return share_interval(np.array([is_hit(v) for v in cases], np.bool_), seed=seed)


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return float(np.median(known)) if known else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _counts(names: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(names).items()))
