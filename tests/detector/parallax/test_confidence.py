"""Scores, their calibration, and the reliability diagram."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from detector.parallax.confidence import (
    CALIBRATION,
    calibrated,
    confidence,
    fitted_table,
    reliability,
    score,
)
from detector.parallax.map_memory import MapMemory, RememberedMap
from detector.parallax.void_map import Gap, VoidMap, VoidMapParams


def seen(free_m: float, *, count: int = 60, sigma_m: float = 0.1) -> VoidMap:
    found = VoidMap.unknown()
    known = np.abs(np.degrees(found.azimuth_rad)) <= 35.0
    return VoidMap(
        found.azimuth_rad,
        np.where(known, free_m, 0.0),
        np.where(known, count, 0),
        np.where(known, sigma_m, np.inf),
        known,
    )


def scored(*maps: VoidMap) -> float:
    memory = MapMemory()
    for found in maps:
        memory.add(found, (0.0, 0.0), 0.0)
    remembered = memory.remembered((0.0, 0.0), 0.0)
    gap = memory.answer(remembered.found, VoidMapParams())
    assert gap is not None
    value = confidence(remembered, gap)
    assert 0.0 <= value <= 1.0
    return score(remembered, gap)


def test_what_agrees_is_sure() -> None:
    same = [seen(5.0)] * 4
    assert scored(*same) > 0.9
    assert scored(*same) > scored(seen(5.0)), "one profile alone is less"
    assert scored(*same) > scored(seen(5.0), seen(5.0), seen(2.0), seen(9.0))
    assert scored(*same) > scored(*[seen(5.0, count=3)] * 4)
    assert scored(*same) > scored(*[seen(5.0, sigma_m=3.0)] * 4)


def test_where_nothing_is_known_there_is_no_confidence() -> None:
    nothing = np.zeros(360, np.intp)
    gap = Gap(0.0, 5.0, 0.1, 0.2, 10)
    assert score(RememberedMap(VoidMap.unknown(), nothing, nothing), gap) == 0.0


def test_the_table_in_use_is_monotone_and_within_bounds() -> None:
    values = [calibrated(value) for value in np.linspace(0.0, 1.0, 50)]
    assert all(a <= b for a, b in itertools.pairwise(values))
    assert values[0] == CALIBRATION[0][1]
    assert values[-1] == CALIBRATION[-1][1]


@pytest.mark.parametrize(
    "table", [((0.5, 0.5), (0.2, 0.6)), ((0.2, 0.6), (0.5, 0.5)), ((0.2, 0.6), (0.5, 1.5)), ()]
)
def test_a_table_that_is_none_is_refused(table: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError, match="expected"):
        calibrated(0.3, table)


def test_a_fitted_table_finds_how_often_answers_are_right() -> None:
    rng = np.random.default_rng(1)
    scores = rng.uniform(0.0, 1.0, 8000)
    right = rng.uniform(size=scores.size) < scores**2
    table = fitted_table(scores, np.asarray(right))
    for value in (0.3, 0.5, 0.7, 0.9):
        assert calibrated(value, table) == pytest.approx(value**2, abs=0.06)
    found = reliability(np.array([calibrated(value, table) for value in scores]), np.asarray(right))
    assert sum(part.answers for part in found) == 8000
    assert max(abs(part.confidence - part.right) for part in found) < 0.06


def test_a_fitted_table_is_monotone_whatever_the_outcomes() -> None:
    rng = np.random.default_rng(2)
    scores = rng.uniform(0.0, 1.0, 60)
    table = fitted_table(scores, np.asarray(rng.uniform(size=60) < 1.0 - scores))
    assert all(a[1] <= b[1] and a[0] < b[0] for a, b in itertools.pairwise(table))
    assert math.isfinite(calibrated(0.5, table))
    with pytest.raises(ValueError, match="at least 16"):
        fitted_table(scores[:5], np.ones(5, np.bool_))


def test_no_answers_make_no_diagram() -> None:
    assert reliability(np.zeros(0), np.zeros(0, np.bool_)) == ()
