from __future__ import annotations

import numpy as np
import pytest

from detector.params import DetectorParams
from detector.pipeline import VoidDetector
from detector.results import Direction, NoDetection
from tests.reference import literal, pairs

EXPECTED = {
    "brick_far": "single_plane",
    "brick_near": "single_plane",
    "approach": "single_plane",
    "still": "no_motion",
    "blank": "too_few_features_earlier",
}


def kind_of(detection):
    if isinstance(detection, NoDetection):
        return detection.reason.value
    return detection.kind.value if isinstance(detection, Direction) else "single_plane"


@pytest.mark.parametrize("name", [*pairs.FILES, *pairs.MADE])
def test_same_counts_parameters_and_answer_as_the_literal_transcription(name):
    earlier, later = pairs.load(name)
    oracle = literal.run(earlier, later, literal.evenly_spaced)
    detector = VoidDetector(DetectorParams.preset("paper"), starts=literal.evenly_spaced)

    detection = detector.detect(earlier, later).detection

    diagnostics = detection.diagnostics
    assert kind_of(detection) == oracle.kind
    assert EXPECTED.get(name, oracle.kind) == oracle.kind
    counts = [diagnostics.n_after_distribution, diagnostics.n_after_length, diagnostics.n_after_angle]
    assert counts[: len(oracle.counts)] == oracle.counts
    if oracle.n is None:
        return
    assert (diagnostics.p, diagnostics.n, diagnostics.k) == (oracle.p, oracle.n, oracle.k)
    np.testing.assert_allclose(diagnostics.centre_magnitudes_px, oracle.magnitudes, rtol=1e-9)
    assert diagnostics.plane_statistic == pytest.approx(oracle.deviation)
    if isinstance(detection, Direction):
        assert len(diagnostics.lines_px) == oracle.n_lines
        np.testing.assert_allclose(diagnostics.candidates_px, oracle.candidates)
        assert (detection.x_px, detection.y_px) == pytest.approx(oracle.at)


def test_the_pairs_reach_a_direction_and_the_line_stage():
    answers = {
        name: literal.run(*pairs.load(name), literal.evenly_spaced) for name in ("window", "office_open")
    }
    assert any(answer.at is not None for answer in answers.values())
    assert any(answer.n_lines > 1 and answer.candidates for answer in answers.values())
