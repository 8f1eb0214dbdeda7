from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from detector.vote import elect

LMCC = np.array([100.0, 100.0])
ENDS = np.array([[300.0, 100.0], [305.0, 100.0], [500.0, 100.0]])


@given(lmcc_flow=st.floats(1.0, 100.0), ratio=st.floats(0.5, 1.5), tolerance=st.sampled_from([0.05, 0.2]))
def test_elected_within_the_share_of_the_lmccs_flow(lmcc_flow: float, ratio: float, tolerance: float) -> None:
    if abs(abs(ratio - 1.0) - tolerance) < 1e-9:
        return
    flows = np.full(3, ratio * lmcc_flow)
    found = elect(np.array([[300.0, 90.0]]), LMCC, lmcc_flow, ENDS, flows, 2, tolerance)
    assert (found is not None) == (abs(ratio - 1.0) < tolerance)


def test_the_limit_itself_does_not_elect() -> None:
    candidate = np.array([[300.0, 90.0]])
    for flow in (15.0, 25.0):
        assert elect(candidate, LMCC, 20.0, ENDS, np.full(3, flow), 1, 0.25) is None


def test_the_flow_at_the_candidate_is_the_mean_of_k_neighbours() -> None:
    candidate, flows = np.array([[300.0, 100.0]]), np.array([8.0, 12.0, 40.0])
    assert elect(candidate, LMCC, 10.0, ENDS, flows, 1) is None
    assert elect(candidate, LMCC, 10.0, ENDS, flows, 2) is not None
    assert elect(candidate, LMCC, 10.0, ENDS, flows, 3) is None


def test_the_share_is_of_the_lmccs_flow_not_of_the_candidates() -> None:
    candidate = np.array([[300.0, 100.0]])
    # 1 of 4 is a quarter, 1 of 5 a fifth: 0.22 lies between.
    assert elect(candidate, LMCC, 4.0, ENDS, np.full(3, 5.0), 1, 0.22) is None
    assert elect(candidate, LMCC, 5.0, ENDS, np.full(3, 4.0), 1, 0.22) is not None


def test_the_nearest_candidate_is_examined_wherever_it_stands_in_the_list() -> None:
    flows = np.array([99.0, 99.0, 10.0])
    near, far = [300.0, 100.0], [500.0, 100.0]
    for order in ([near, far], [far, near]):
        assert elect(np.array(order), LMCC, 10.0, ENDS, flows, 1) is None
