"""Known flows by warping: shifts, zooms and turns of an image; single cases are in test_steps."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.camera_model import CameraModel
from detector.features import feature_locations
from detector.flow import Tracks, derotate, distribution_filter, track
from tests.reference.pairs import texture

CAMERA = CameraModel.from_hfov(640, 480, 80.0)
DISTORTED = CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.2, 0.05, 0.0, 0.0))


def warped(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    size = image.shape[::-1]
    return cv2.warpAffine(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (3.5, -2.25), (-25.0, 14.0)])
def test_a_known_shift_is_found(shift_px: tuple[float, float]) -> None:
    earlier = texture(320, 240)
    later = warped(earlier, np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]]))
    start = feature_locations(earlier)
    start = start[(start > 40).all(axis=1) & (start < [280, 200]).all(axis=1)]
    end, ok = track(earlier, later, start)
    assert ok.mean() > 0.95
    assert np.median(np.linalg.norm(end - start - shift_px, axis=1)) < 0.05


def test_a_good_guess_finds_what_is_too_far_without() -> None:
    earlier = texture(320, 240)
    later = warped(earlier, np.array([[1.0, 0.0, 60.0], [0.0, 1.0, 0.0]]))
    start = feature_locations(earlier)
    start = start[(start[:, 0] > 30) & (start[:, 0] < 230)]

    def share_found(guess: np.ndarray | None) -> float:
        end, ok = track(earlier, later, start, levels=1, guess_px=guess)
        return float(np.mean(ok & (np.abs(end - start - [60.0, 0.0]).max(axis=1) < 0.5)))

    assert share_found(start + np.float32((58.0, 1.0))) > 0.9
    assert share_found(None) < 0.3


def test_the_guess_is_not_written_to() -> None:
    earlier = texture(320, 240)
    start = feature_locations(earlier)
    guess = start + np.float32(1.5)
    before = guess.copy()
    track(earlier, earlier, start, guess_px=guess)
    np.testing.assert_array_equal(guess, before)


def test_there_and_back_drops_what_a_later_object_hides() -> None:
    earlier = texture(320, 240)
    later = earlier.copy()
    later[60:180, 100:220] = texture(120, 120, seed=9)
    start = feature_locations(earlier)
    end, there = track(earlier, later, start)
    returned, back = track(later, earlier, end)
    kept = there & back & distribution_filter(start, returned, 0.5)
    hidden = ((start > [110, 70]) & (start < [210, 170])).all(axis=1)
    clear = (start[:, 0] < 80) | (start[:, 0] > 240)
    assert kept[hidden].mean() < 0.4
    assert kept[clear].mean() > 0.95


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@settings(max_examples=25, deadline=None)
@given(x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1), z=st.floats(-0.2, 0.2))
def test_derotation_undoes_its_inverse(camera: CameraModel, x: float, y: float, z: float) -> None:
    turn = cv2.Rodrigues(np.array([x, y, z]))[0]
    points = np.random.default_rng(0).uniform([160, 120], [480, 360], (30, 2))
    np.testing.assert_allclose(derotate(derotate(points, camera, turn), camera, turn.T), points, atol=1e-4)


def test_what_turns_out_of_sight_has_no_place() -> None:
    half_turn = np.diag([-1.0, 1.0, -1.0])
    assert np.isnan(derotate(np.array([[320.0, 240.0]]), CAMERA, half_turn)).all()


@given(
    flow=st.lists(
        st.tuples(st.floats(-50, 50), st.floats(-50, 50)).filter(lambda v: np.hypot(*v) > 1e-6),
        min_size=1,
        max_size=30,
    )
)
def test_length_and_angle_say_the_vector(flow: list[tuple[float, float]]) -> None:
    vectors = np.array(flow)
    tracks = Tracks(np.full_like(vectors, 7.0), vectors + 7.0)
    alpha = np.radians(tracks.angles_deg)
    assert (tracks.angles_deg >= 0.0).all()
    assert (tracks.angles_deg < 360.0).all()
    again = tracks.lengths_px[:, None] * np.column_stack([np.cos(alpha), np.sin(alpha)])
    np.testing.assert_allclose(again, vectors, atol=1e-9)


def test_selection_keeps_starts_and_ends_together() -> None:
    tracks = Tracks(np.arange(8.0).reshape(4, 2), 10.0 + np.arange(8.0).reshape(4, 2))
    chosen = tracks[np.array([True, False, False, True])]
    assert len(chosen) == 2
    np.testing.assert_array_equal(chosen.flow_px, np.full((2, 2), 10.0))
    np.testing.assert_array_equal(chosen.start_px, [[0, 1], [6, 7]])
