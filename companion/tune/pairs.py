"""Pairs of frames with truth, as ``detector evaluate`` knows them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.tune.cases import Part, held_out_count
from companion.tune.errors import TrialError, TuneError
from companion.tune.score import answer_score
from companion.tune.space import Settings as Tried
from companion.tune.space import params_model, usual_params
from detector.commands import inputs
from detector.evaluation import dataset
from detector.evaluation.dataset import DatasetError, ImageSet, Pair
from detector.evaluation.judgement import has_direction_truth, is_single_plane
from detector.evaluation.methods import Method, PaperMethod, ParallaxMethod
from detector.evaluation.run import Poses, Settings, evaluate
from detector.parallax.params import ParallaxParams
from detector.params import DetectorParams, ParamsError, validated

_RECORDINGS: Final = frozenset({".mcap", ".mp4", ".avi", ".mkv", ".mov", ".webm"})


@dataclass(frozen=True, slots=True)
class PairSet:
    """A folder's pairs that have a truth, in two parts that share no frame."""

    images: ImageSet
    searched: tuple[Pair, ...]
    held_out: tuple[Pair, ...]


def load_pairs(
    folder: Path, *, min_baseline_m: float | None, truth: Path | None, limit: int | None, hold_out: float
) -> PairSet:
    """Read a folder in the layout of docs/evaluation.md.

    The last pairs are held out, not random ones: neighbouring pairs of a walk are alike.

    Parameters
    ----------
    folder
        With ``groundtruth.json``, or ``poses.json``.
    min_baseline_m
        Form pairs from the poses, this far apart; None: the file's.
    truth
        Another folder that knows more of frames of the same names.
    limit
        Most pairs, evenly chosen; None: all.
    hold_out
        Share of the pairs.

    Raises
    ------
    TuneError
        There is nothing to judge by.
    """
    try:
        images = _images(folder)
        if truth is not None:
            images = dataset.with_truth_of(images, _images(truth))
        pairs = images.pairs if min_baseline_m is None else dataset.pairs_by_baseline(images, min_baseline_m)
    except DatasetError as error:
        raise TuneError(inputs.one_line(error)) from error
    if not pairs:
        hint = "; --min-baseline M forms pairs from the poses" if images.has_poses else ""
        raise TuneError(f"{folder}: holds no pairs{hint}")
    known = [pair for pair in pairs if _has_truth(images, pair)]
    if not known:
        raise TuneError(
            f"{folder}: nothing is known of what its {len(pairs)} pairs show, so no answer can be judged; "
            "poses alone are no truth (--truth DIR: another set that knows more of the same frames)"
        )
    if limit is not None and len(known) > limit:
        known = [known[i] for i in np.linspace(0, len(known) - 1, limit).round().astype(int)]
    first_held = len(known) - held_out_count(len(known), hold_out)
    held_out = tuple(known[first_held:])
    frames = {name for pair in held_out for name in (pair.a, pair.b)}
    searched = tuple(pair for pair in known[:first_held] if not {pair.a, pair.b} & frames)
    if not searched:
        raise TuneError(f"{folder}: {len(known)} pairs with truth are too few to hold some out; --hold-out 0")
    return PairSet(images, searched, held_out)


class TruePairs:
    """Answers to pairs against their truth.

    Parameters
    ----------
    sets
        At least one.
    method, preset
        Whose parameters are searched.
    poses
        What the method is told of the motion.
    """

    def __init__(
        self,
        sets: Sequence[PairSet],
        *,
        method: Literal["paper", "parallax"],
        preset: Literal["default", "paper"],
        poses: Poses = "full",
    ) -> None:
        self._sets, self._method, self._preset = tuple(sets), method, preset
        self._poses: Poses = poses

    def count(self, part: Part) -> int:
        """Return how many pairs there are."""
        return sum(len(_pairs_of(each, part)) for each in self._sets)

    def scores(
        self, settings: Tried, part: Part, on_case: Callable[[], None] = lambda: None
    ) -> NDArray[np.float64]:
        """Return what each answer is worth (:func:`companion.tune.score.answer_score`); every pair is a first loop.

        Raises
        ------
        TrialError
            The settings do not go together.
        TuneError
            An image cannot be used.
        """
        cv2.setNumThreads(1)  # searches run side by side
        found: list[float] = []
        judged_by = Settings(self._method, self._preset, DetectorParams.preset(self._preset), self._poses)
        for each in self._sets:
            try:
                verdicts = evaluate(
                    each.images,
                    _pairs_of(each, part),
                    judged_by,
                    inputs.read_image,
                    method=method_with(self._method, self._preset, settings),
                    on_step=on_case,
                ).verdicts
            except (DatasetError, inputs.InputError) as error:
                raise TuneError(inputs.one_line(error)) from error
            found += [answer_score(verdict) for verdict in verdicts]
        return np.array(found)

    def about(self) -> dict[str, Any]:
        """Return what the pairs are; files by name alone, so that machines may have them in different places."""
        listed = [
            (each.images.name, part, pair.a, pair.b)
            for each in self._sets
            for part in ("searched", "held_out")
            for pair in _pairs_of(each, part)
        ]
        return {
            "sets": [each.images.name for each in self._sets],
            "method": self._method,
            "preset": self._preset,
            "poses": self._poses,
            "pairs": hashlib.sha256(repr(listed).encode()).hexdigest()[:16],
        }


def method_with(
    method: Literal["paper", "parallax"], preset: Literal["default", "paper"], settings: Tried
) -> Method:
    """Return a method with some of its parameters replaced.

    Raises
    ------
    TrialError
        They are not allowed together.
    """
    try:
        params = validated(
            params_model(method), {**usual_params(method, preset).model_dump(), **settings}, "settings"
        )
    except ParamsError as error:
        raise TrialError(inputs.one_line(error)) from error
    if isinstance(params, ParallaxParams):
        return ParallaxMethod(DetectorParams.preset(preset), params)
    return PaperMethod(params)


def _pairs_of(each: PairSet, part: str) -> tuple[Pair, ...]:
    return each.searched if part == "searched" else each.held_out


def _has_truth(images: ImageSet, pair: Pair) -> bool:
    truth = images.truth_of(pair)
    return truth.no_motion is True or is_single_plane(truth) is not None or has_direction_truth(truth)


def _images(folder: Path) -> ImageSet:
    if folder.is_file() and folder.suffix.lower() in _RECORDINGS:
        raise TuneError(
            f"{folder}: a recording does not say where the free way was, so no answer can be judged by it; needed is a folder "
            "with a groundtruth.json (docs/evaluation.md), or --world for simulated flights"
        )
    if not folder.is_dir():
        raise TuneError(f"{folder}: is not a folder")
    for name in (dataset.TRUTH_FILE, dataset.POSES_FILE):
        if (folder / name).is_file():
            return dataset.load_truth(folder / name)
    what = "recordings have no truth; " if any(folder.glob("*.mcap")) else ""
    raise TuneError(f"{folder}: {what}found neither {dataset.TRUTH_FILE} nor {dataset.POSES_FILE}")
