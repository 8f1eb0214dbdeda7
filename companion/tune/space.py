"""What is searched: settings with their ranges, from the limits of their pydantic fields."""

from __future__ import annotations

import math
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from companion.config import Config
from companion.tune.errors import TuneError
from detector.parallax.params import ParallaxParams
from detector.params import DetectorParams

Value = bool | int | float | str
Settings = Mapping[str, Value]
"""By name: a parameter of the method (``round_trip_px``), or ``table.key`` of the configuration (``guidance.step_margin_m``)."""

USUAL: Final[Mapping[str, tuple[str, ...]]] = types.MappingProxyType(
    {
        "paper": (
            "sift_contrast",
            "min_features",
            "min_flow_vectors",
            "round_trip_px",
            "shortest_fraction",
            "angle_gain",
            "angle_statistics",
            "nearest_change",
            "plane_share",
            "plane_ratio",
            "vote_tolerance",
            "lines_wanted",
        ),
        "parallax": (
            "round_trip_px",
            "flow_sigma_px",
            "grey_sigma",
            "noise_factor",
            "loose_sigma_px",
            "informative_sigma_px",
            "attitude_sigma_deg",
            "velocity_sigma_deg",
            "cauchy_px",
            "correlated_samples",
            "plane_share",
        ),
    }
)
"""What is searched where nothing is named: what decides answers, without what decides speed, and without what says what counts as an answer."""
USUAL_IN_FLIGHT: Final = (
    "detector.baseline_m",
    "guidance.max_step_m",
    "guidance.step_margin_m",
    "guidance.align_deg",
    "guidance.agree_deg",
    "guidance.redetect_distance_m",
    "guidance.min_confidence",
)
_TABLES: Final = ("detector", "guidance")
_STEPS: Final[Mapping[str, int]] = types.MappingProxyType({"lk_window_px": 2})
"""Whole numbers of which not every one is allowed, counted from the usual one."""
_DIGITS: Final = 4


@dataclass(frozen=True, slots=True)
class Dimension:
    """One setting that is searched.

    Attributes
    ----------
    name
        As in :data:`Settings`.
    usual
        Its value without a search.
    low, high
        Ends of its range, inclusive; of numbers.
    whole, step
        Whether it is a whole number, and which ones are allowed.
    is_log
        Ratios count, not differences.
    choices
        Of what is no number; empty else.
    """

    name: str
    usual: Value
    low: float = math.nan
    high: float = math.nan
    whole: bool = False
    step: int = 1
    is_log: bool = False
    choices: tuple[Value, ...] = ()

    def tidy(self, value: Value) -> Value:
        """Return a value as it is tried and written: numbers to four digits, within the range."""
        if self.choices or self.whole or not isinstance(value, int | float):
            return value
        return min(max(float(f"{value:.{_DIGITS}g}"), self.low), self.high)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        if self.choices:
            return {"name": self.name, "usual": self.usual, "choices": list(self.choices)}
        return {"name": self.name, "usual": self.usual, "low": self.low, "high": self.high}


def params_model(method: str) -> type[DetectorParams] | type[ParallaxParams]:
    """Return the model of a method's own parameters."""
    return DetectorParams if method == "paper" else ParallaxParams


def usual_params(method: str, preset: Literal["paper", "default"]) -> BaseModel:
    """Return a method's parameters without a search."""
    return DetectorParams.preset(preset) if method == "paper" else ParallaxParams()


def dimensions(
    asked: Sequence[str], usual: BaseModel, *, spread: float, with_tables: bool
) -> tuple[Dimension, ...]:
    """Return what is searched.

    Parameters
    ----------
    asked
        Each ``NAME``, ``NAME=LOW..HIGH`` or ``NAME=A,B,C``.
    usual
        The method's parameters without a search.
    spread
        Where no range is given: from the usual value divided by this to it multiplied by this, within the field's limits.
    with_tables
        Whether ``table.key`` of the configuration may be searched (in flights).

    Raises
    ------
    TuneError
        A name is unknown or there twice, or its range is not allowed.
    """
    found: dict[str, Dimension] = {}
    for text in asked:
        name, _, wanted = (part.strip() for part in text.partition("="))
        if name in found:
            raise TuneError(f"--search {name}: is named twice")
        found[name] = _dimension(name, wanted, usual, spread, with_tables=with_tables)
    return tuple(found.values())


def _dimension(name: str, wanted: str, usual: BaseModel, spread: float, *, with_tables: bool) -> Dimension:
    field, value = _field(name, usual, with_tables=with_tables)
    choices = _choices(field)
    if choices:
        known = {str(choice).lower(): choice for choice in choices}
        picked = [part.strip() for part in wanted.split(",")] if wanted else list(known)
        if not set(picked) <= set(known) or len(set(picked)) < 2:
            raise TuneError(
                f"--search {name}: found {wanted!r}, allowed are two or more of {', '.join(known)}"
            )
        return Dimension(name, value, choices=tuple(known[part] for part in picked))
    if not isinstance(value, int | float):
        raise TuneError(f"--search {name}: is text; numbers and choices can be searched")
    low, high = _limits(field)
    whole, step = field.annotation is int, _STEPS.get(name, 1)
    if wanted:
        least, most = _given(name, wanted, whole=whole)
        if not low <= least < most <= high:
            raise TuneError(f"--search {name}: found {wanted}, allowed is LOW..HIGH from {low:g} to {high:g}")
    elif value > 0:
        least, most = max(low, value / spread), min(high, value * spread)
    else:
        least, most = low, high
    if not (math.isfinite(least) and math.isfinite(most)):
        raise TuneError(f"--search {name}: has no limits of its own; give {name}=LOW..HIGH")
    if whole:
        least, most = math.ceil(least), math.floor(most)
        least += (round(value) - least) % step
        most -= (most - least) % step
    if not least < most:
        raise TuneError(f"--search {name}: nothing to choose from between {least:g} and {most:g}")
    found = Dimension(name, value, least, most, whole, step, is_log=least > 0 and step == 1)
    # The usual value is tried first, so it lies in the range.
    return replace(found, low=min(found.low, value), high=max(found.high, value))


def _field(name: str, usual: BaseModel, *, with_tables: bool) -> tuple[FieldInfo, Value]:
    table, dot, key = name.partition(".")
    if dot and with_tables and table in _TABLES:
        section = getattr(Config(), table)
        fields = type(section).model_fields
        if key in fields:
            return fields[key], getattr(section, key)
        raise TuneError(f"--search {name}: no such setting; allowed are {', '.join(fields)}")
    fields = type(usual).model_fields
    if name not in fields:
        more = f", and {' and '.join(_TABLES)} with their keys" if with_tables else ""
        raise TuneError(f"--search {name}: no such setting; allowed are {', '.join(fields)}{more}")
    return fields[name], getattr(usual, name)


def _choices(field: FieldInfo) -> tuple[Value, ...]:
    if field.annotation is bool:
        return (False, True)
    if get_origin(field.annotation) is Literal:
        return get_args(field.annotation)
    return ()


def _limits(field: FieldInfo) -> tuple[float, float]:
    low, high = -math.inf, math.inf
    for limit in field.metadata:
        match limit:
            case Ge(ge=at):
                low = max(low, float(at))  # type: ignore[arg-type] # annotated_types says "comparable"
            case Gt(gt=at):
                low = max(low, math.nextafter(float(at), math.inf))  # type: ignore[arg-type] # likewise
            case Le(le=at):
                high = min(high, float(at))  # type: ignore[arg-type] # likewise
            case Lt(lt=at):
                high = min(high, math.nextafter(float(at), -math.inf))  # type: ignore[arg-type] # likewise
    return low, high


def _given(name: str, wanted: str, *, whole: bool) -> tuple[float, float]:
    low, dots, high = wanted.partition("..")
    try:
        ends = float(low), float(high)
    except ValueError:
        dots = ""
    if not dots or not all(math.isfinite(end) for end in ends):
        raise TuneError(f"--search {name}: found {wanted!r}, needed is LOW..HIGH such as {name}=1..2")
    if whole and any(end != round(end) for end in ends):
        raise TuneError(f"--search {name}: found {wanted}, needed are whole numbers")
    return ends
