"""Two evaluations of the same pairs, compared: differences with paired bootstrap intervals, and how often they agree.

Works on the plain values of :func:`detector.evaluation.run.summary`, so that a saved evaluation can be compared too. Pairing matters: both
saw the same pairs, so hard pairs do not blur the difference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from detector.evaluation.bootstrap import known_mean, known_median, resampled
from detector.evaluation.methods import NONE, SINGLE_PLANE

SAME_PLACE_SHARE: Final = 0.05
"""Of the width: two directions as near as this are the same answer."""

Record = Mapping[str, Any]
"""One entry of ``per_pair`` or ``per_frame``."""


class ComparisonError(ValueError):
    """Two evaluations do not belong together, or one of them is not an evaluation; the message is one line."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of both evaluations, and the difference (first less second).

    Attributes
    ----------
    name
        What it is.
    first, second
        Its values; None where it is not defined.
    difference, interval
        First less second, and the 95 % interval of that; None where either is not defined.
    better
        Whether the larger or the smaller value is better.
    """

    name: str
    first: float | None
    second: float | None
    difference: float | None
    interval: tuple[float, float] | None
    better: Literal["larger", "smaller"]

    @property
    def verdict(self) -> str:
        """``better`` or ``worse`` where the whole interval says so of the first one, else ``no difference shown``."""
        if self.interval is None:
            return "not known"
        low, high = self.interval if self.better == "larger" else (-self.interval[1], -self.interval[0])
        return "better" if low > 0.0 else "worse" if high < 0.0 else "no difference shown"


@dataclass(frozen=True, slots=True)
class _Measure:
    """How a figure comes from records: NaN where a record does not count."""

    name: str
    better: Literal["larger", "smaller"]
    reduce: Literal["mean", "median"]
    value: Callable[[Record], float | None]


def _is_direction(record: Record) -> bool:
    return record["kind"] not in (SINGLE_PLANE, NONE)


def _flag(value: bool | None) -> float | None:
    return None if value is None else float(value)


def _if(condition: bool, value: bool) -> float | None:
    return float(value) if condition else None


_PAIR_MEASURES: Final = (
    _Measure("direction right, of those answered", "larger", "mean", lambda r: _flag(r["right"])),
    _Measure(
        "direction right, of all with truth",
        "larger",
        "mean",
        lambda r: _if(r["has_direction_truth"], r["right"] is True),
    ),
    _Measure("direction error (width)", "smaller", "median", lambda r: r["error_width"]),
    _Measure("direction profile ratio", "larger", "median", lambda r: r["profile_ratio"]),
    _Measure(
        "planes found",
        "larger",
        "mean",
        lambda r: _if(r["single_plane_truth"] is True, r["kind"] == SINGLE_PLANE),
    ),
    _Measure(
        "false planes",
        "smaller",
        "mean",
        lambda r: _if(r["single_plane_truth"] is False, r["kind"] == SINGLE_PLANE),
    ),
    _Measure(
        "silent without motion",
        "larger",
        "mean",
        lambda r: _if(r["no_motion_truth"] is True, r["kind"] == NONE),
    ),
    _Measure("focus of expansion error (px)", "smaller", "median", lambda r: r["foe_px"]),
    _Measure("time to contact error (relative)", "smaller", "median", lambda r: r["contact_error"]),
    _Measure("seconds", "smaller", "median", lambda r: r["seconds"]),
)
_FRAME_MEASURES: Final = (
    _Measure("vanishing point right", "larger", "mean", lambda r: float(r["within_tenth_width"])),
    _Measure("vanishing point error (width)", "smaller", "median", lambda r: r["error_width"]),
)


def compare(first: Sequence[Record], second: Sequence[Record], *, seed: int = 0) -> dict[str, Any]:
    """Compare evaluations set by set and over all sets together.

    Parameters
    ----------
    first, second
        Objects of :func:`detector.evaluation.run.summary`, of the same sets in the same order.
    seed
        Of the bootstrap.

    Returns
    -------
    ``sets``, a list, and ``all``, the sets' pairs as one; each with ``name``, ``figures`` (see :class:`Figure`) and ``agreement``.

    Raises
    ------
    ComparisonError
        They are not of the same sets and pairs.
    """
    if [item.get("name") for item in first] != [item.get("name") for item in second]:
        raise ComparisonError(
            f"evaluations of {_names(first)} and of {_names(second)} cannot be compared: sets differ"
        )
    try:
        paired = [
            (
                str(one["name"]),
                _paired(one, other, "per_pair", ("a", "b")),
                _paired(one, other, "per_frame", ("frame",)),
            )
            for one, other in zip(first, second, strict=True)
        ]
        sets = [_entry(name, pairs, frames, seed) for name, pairs, frames in paired]
        pooled_pairs = [record for _, pairs, _ in paired for record in pairs]
        pooled_frames = [record for _, _, frames in paired for record in frames]
        return {"sets": sets, "all": _entry("all sets", pooled_pairs, pooled_frames, seed)}
    except (KeyError, TypeError) as error:
        raise ComparisonError(f"not an evaluation of this version: {type(error).__name__} {error}") from error


_Paired = Sequence[tuple[Record, Record]]


def _paired(one: Record, other: Record, key: str, by: tuple[str, ...]) -> list[tuple[Record, Record]]:
    seconds = {tuple(record[name] for name in by): record for record in other[key]}
    firsts = {tuple(record[name] for name in by): record for record in one[key]}
    if set(firsts) != set(seconds):
        differing = len(set(firsts) ^ set(seconds))
        raise ComparisonError(f"{one['name']}: {differing} entries of {key} stand in one evaluation only")
    return [(record, seconds[name]) for name, record in firsts.items()]


def _entry(name: str, pairs: _Paired, frames: _Paired, seed: int) -> dict[str, Any]:
    figures = [_figure(measure, pairs, seed) for measure in _PAIR_MEASURES]
    figures += [_figure(measure, frames, seed) for measure in _FRAME_MEASURES]
    return {
        "name": name,
        "figures": [
            {
                "name": figure.name,
                "first": figure.first,
                "second": figure.second,
                "difference": figure.difference,
                "interval": figure.interval,
                "better": figure.better,
                "verdict": figure.verdict,
            }
            for figure in figures
            if figure.first is not None or figure.second is not None
        ],
        "agreement": _agreement(pairs),
    }


def _figure(measure: _Measure, paired: _Paired, seed: int) -> Figure:
    first, second = (
        np.array([_number(measure.value(records[side])) for records in paired], np.float64) for side in (0, 1)
    )
    reduce = known_mean if measure.reduce == "mean" else known_median
    interval = None
    if len(paired):
        values = float(reduce(first[None])[0]), float(reduce(second[None])[0])
    else:
        values = math.nan, math.nan
    difference = values[0] - values[1]
    if math.isfinite(difference):
        # One draw for both: the same pairs stand on either side.
        interval = resampled(
            len(first), lambda drawn: reduce(first[drawn]) - reduce(second[drawn]), seed=seed
        )
    return Figure(
        name=measure.name,
        first=_known(values[0]),
        second=_known(values[1]),
        difference=_known(difference),
        interval=interval,
        better=measure.better,
    )


def _agreement(pairs: _Paired) -> dict[str, Any]:
    """Return how often both say the same: the kind as it is written, and the answer as it would be flown."""
    both = [(one, other) for one, other in pairs if _is_direction(one) and _is_direction(other)]
    near = [_offset_share(one, other) <= SAME_PLACE_SHARE for one, other in both]
    alike = [
        (one["kind"] == other["kind"]) if not (_is_direction(one) and _is_direction(other)) else None
        for one, other in pairs
    ]
    return {
        "pairs": len(pairs),
        "same_kind": sum(one["kind"] == other["kind"] for one, other in pairs),
        "both_directions": len(both),
        "within_twentieth_width": sum(near),
        "same_answer": sum(near) + sum(value is True for value in alike),
    }


def _offset_share(one: Record, other: Record) -> float:
    return math.dist((one["x_px"], one["y_px"]), (other["x_px"], other["y_px"])) / float(one["width_px"])


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _names(evaluations: Sequence[Record]) -> str:
    return ", ".join(str(item.get("name")) for item in evaluations) or "nothing"
