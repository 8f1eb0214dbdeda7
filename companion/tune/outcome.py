"""What came of a search: the best settings, and whether their gain holds on cases that were not searched on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from companion.tune.cases import Cases
from companion.tune.space import Settings
from detector.evaluation.bootstrap import resampled

Verdict = Literal["holds", "not shown", "lost", "unknown"]


@dataclass(frozen=True, slots=True)
class Gain:
    """The best settings against the usual ones on the same cases.

    Attributes
    ----------
    cases
        How many.
    usual, best
        Mean scores.
    difference
        Best less usual.
    interval
        95 %, paired bootstrap over the cases; None where it cannot be told.
    """

    cases: int
    usual: float
    best: float
    difference: float
    interval: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """A search's end.

    Attributes
    ----------
    trials
        Finished ones.
    best_trial
        Number of the best.
    settings, usual
        The best settings and the usual ones, by name.
    searched, held_out
        What was gained; None where nothing was held out.
    importances
        Share of each setting in the differences between trials.
    """

    trials: int
    best_trial: int
    settings: Settings
    usual: Settings
    searched: Gain
    held_out: Gain | None
    importances: Mapping[str, float]

    @property
    def verdict(self) -> Verdict:
        """Whether the gain holds on the cases held out.

        ``holds``: the whole interval lies above zero. ``lost``: nothing is left of it. ``not shown``: between the two. ``unknown``: nothing was held out.
        """
        held = self.held_out
        if held is None:
            return "unknown"
        if held.difference <= 0.0:
            return "lost"
        return "holds" if held.interval is not None and held.interval[0] > 0.0 else "not shown"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {**asdict(self), "verdict": self.verdict}


def judged(
    cases: Cases,
    settings: Settings,
    usual: Settings,
    *,
    searched: Gain,
    trials: int,
    best_trial: int,
    importances: Mapping[str, float],
) -> Outcome:
    """Judge the best settings and the usual ones on the cases held out.

    Raises
    ------
    companion.tune.errors.TrialError
        They cannot be judged.
    """
    held_out = None
    if cases.count("held_out"):
        before = cases.scores(usual, "held_out")
        is_same = dict(settings) == dict(usual)
        held_out = gain_of(before, before if is_same else cases.scores(settings, "held_out"))
    return Outcome(trials, best_trial, settings, usual, searched, held_out, importances)


def gain_of(usual: NDArray[np.float64], best: NDArray[np.float64], *, seed: int = 0) -> Gain:
    """Compare scores case by case.

    Parameters
    ----------
    usual, best
        (N,) of the same cases.
    seed
        Of the bootstrap.
    """
    difference = best - usual
    interval = resampled(len(difference), lambda drawn: difference[drawn].mean(axis=1), seed=seed)
    if interval is not None and not all(math.isfinite(end) for end in interval):
        interval = None
    return Gain(len(usual), float(usual.mean()), float(best.mean()), float(difference.mean()), interval)


def warning_of(outcome: Outcome) -> str | None:
    """Return what must be said of the gain; None where it holds."""
    if dict(outcome.settings) == dict(outcome.usual):
        return "no trial did better than the usual settings: keep them"
    match outcome.verdict:
        case "unknown":
            return "nothing was held out: whether the gain is more than luck with these cases is not known"
        case "lost":
            return "the gain does not survive on the cases held out: keep the usual settings, or search on more cases"
        case "not shown":
            return "on the cases held out the gain may be chance: its interval reaches down to none; judge on more cases before you fly it"
    return None


def markdown(outcome: Outcome, files: Sequence[str]) -> str:
    """Return the report for people."""
    lines = [
        "# Search for settings",
        "",
        f"Finished trials: {outcome.trials}; the best is number {outcome.best_trial}.",
        "",
    ]
    if (warning := warning_of(outcome)) is not None:
        lines += [f"**{warning[0].upper()}{warning[1:]}.**", ""]
    lines += [
        "| cases | number | usual settings | best settings | difference (95 %) |",
        "|---|---|---|---|---|",
    ]
    for name, gain in (("searched on", outcome.searched), ("held out", outcome.held_out)):
        if gain is not None:
            ends = "" if gain.interval is None else f" ({gain.interval[0]:+.3f} .. {gain.interval[1]:+.3f})"
            lines.append(
                f"| {name} | {gain.cases} | {gain.usual:.3f} | {gain.best:.3f} | {gain.difference:+.3f}{ends} |"
            )
    lines += ["", "| setting | usual | best | importance |", "|---|---|---|---|"]
    for name in sorted(outcome.settings, key=lambda each: -outcome.importances.get(each, 0.0)):
        share = outcome.importances.get(name)
        lines.append(
            f"| `{name}` | {outcome.usual[name]} | {outcome.settings[name]} | {'-' if share is None else f'{share:.2f}'} |"
        )
    lines += ["", *(f"![{file}]({file})" for file in files)]
    return "\n".join(lines) + "\n"
