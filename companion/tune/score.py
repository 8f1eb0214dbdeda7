"""What an answer, and a flight, is worth (pure)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.evaluation.judgement import Verdict
from detector.evaluation.methods import NONE, SINGLE_PLANE

RIGHT: Final = 1.0
SILENT: Final = 0.25
"""No answer, or a wall where none is: the vehicle waits or turns, which costs time. An answer pays where it is right more often than this."""
WRONG: Final = 0.0
"""A direction that is not free, or one where there is a wall: the vehicle might fly there."""

_NOT_REACHED: Final = 0.25


def answer_score(verdict: Verdict) -> float:
    """Return what an answer is worth, in [0, 1].

    Right: a direction that is right by the truth, a wall that is one, silence where nothing moved. See :data:`SILENT` and :data:`WRONG`.
    """
    if verdict.kind == NONE:
        return RIGHT if verdict.no_motion_truth else SILENT
    if verdict.no_motion_truth:
        return WRONG
    if verdict.kind == SINGLE_PLANE:
        return RIGHT if verdict.single_plane_truth or verdict.near_wall_limit else SILENT
    if verdict.single_plane_truth:
        return WRONG
    if verdict.right is None:  # nothing is known of directions there but that it is no wall
        return RIGHT
    return RIGHT if verdict.right else WRONG


def flight_scores(
    outcomes: Sequence[str], times_s: Sequence[float], limits_s: Sequence[float], *, reachable: Sequence[bool]
) -> NDArray[np.float64]:
    """Return what each of N flights is worth, so that their mean puts collisions first.

    A flight that does not collide is worth 0 to 1: at the goal at once 1, at its last moment a half, not at the goal a quarter (where no way
    leads there: 1). A collision is worth -N, so that the mean is the mean of these less the number of collisions: one collision less is worth
    more than all that can be gained in time.

    Parameters
    ----------
    outcomes
        ``reached``, ``collided``, ``stuck`` or ``timeout``.
    times_s, limits_s
        What each took and was allowed.
    reachable
        Whether a way leads to its goal.
    """
    count = len(outcomes)
    scores = np.empty(count)
    for i, (outcome, time_s, limit_s, is_reachable) in enumerate(
        zip(outcomes, times_s, limits_s, reachable, strict=True)
    ):
        if outcome == "collided":
            scores[i] = -count
        elif not is_reachable:
            scores[i] = 1.0
        elif outcome == "reached":
            scores[i] = 1.0 - 0.5 * min(1.0, max(0.0, time_s / limit_s))
        else:
            scores[i] = _NOT_REACHED
    return scores
