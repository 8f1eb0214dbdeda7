"""All methods on one pair: what each says, how long it takes, and whether it is right where the truth is known."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from detector.evaluation.dataset import ImageSet, Pair
from detector.evaluation.judgement import Verdict, is_right_answer, judge
from detector.evaluation.methods import METHODS, Answer, PairInput
from detector.evaluation.run import scene_of
from detector.params import DetectorParams


@dataclass(frozen=True, slots=True)
class KnownPair:
    """A pair of a set with known truth."""

    images: ImageSet
    pair: Pair


@dataclass(frozen=True, slots=True)
class MethodAnswer:
    """One method on the pair.

    Attributes
    ----------
    method
        A name of :data:`detector.evaluation.methods.METHODS`.
    answer
        Of a first loop.
    seconds
        That it takes from the two plain images, median.
    verdict
        None where no truth is known.
    """

    method: str
    answer: Answer
    seconds: float
    verdict: Verdict | None

    @property
    def right(self) -> bool | None:
        """Whether it is right (:func:`detector.evaluation.judgement.is_right_answer`)."""
        return None if self.verdict is None else is_right_answer(self.verdict)


def answer_side_by_side(
    pair: PairInput,
    params: DetectorParams,
    *,
    known: KnownPair | None = None,
    loops: int = 5,
    timer: Callable[[], float] = time.perf_counter,
) -> tuple[MethodAnswer, ...]:
    """Return what every method says of a pair, in the order of :data:`detector.evaluation.methods.METHODS`.

    Parameters
    ----------
    pair
        What each of them is told.
    params
        Of the paper's method, and of what counts as a usable frame.
    known
        The pair in a set with truth. It is for judging alone: no method is told anything of it.
    loops
        Times that each is timed, all in turns, after one that warms up.
    timer
        Gives seconds.

    Raises
    ------
    ValueError
        There is nothing to time.
    """
    if loops < 1:
        raise ValueError(f"loops: expected 1 or more, got {loops}")
    methods = {name: make(params) for name, make in METHODS.items()}
    answers = {name: method.answer(pair) for name, method in methods.items()}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(loops):
        for name, method in methods.items():
            method.reset()
            begin = timer()
            method.answer(pair)
            seconds[name].append(timer() - begin)
    size_px = (pair.later.shape[1], pair.later.shape[0])
    scene = None if known is None else scene_of(known.images, known.pair, size_px)
    found = []
    for name, answer in answers.items():
        took_s = float(np.median(seconds[name]))
        verdict = None if known is None or scene is None else judge(answer, known.pair, scene, took_s)
        found.append(MethodAnswer(name, answer, took_s, verdict))
    return tuple(found)
