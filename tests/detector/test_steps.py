from __future__ import annotations

import numpy as np
import pytest
from sklearn import metrics
from sklearn.cluster import KMeans

from detector import clusters, features, flow, lines, outliers, vanishing_point, vote
from detector.camera_model import CameraModel
from tests.reference import literal, pairs


def samples(n=200, seed=0):
    rng = np.random.default_rng(seed)
    blobs = rng.uniform([0, 0, 0], [640, 480, 360], (6, 3))
    return blobs[rng.integers(6, size=n)] + rng.normal(0, 20, (n, 3))


class TestFeatures:
    def test_fixed_image_gives_the_same_points_twice(self):
        image = pairs.texture()
        np.testing.assert_array_equal(features.feature_locations(image), features.feature_locations(image))

    def test_unique_drops_only_repeated_locations(self):
        image = pairs.load("office_plane")[0]
        every, once = features.feature_locations(image), features.feature_locations(image, unique=True)
        assert len(once) < len(every)
        assert {tuple(p) for p in every} == {tuple(p) for p in once}

    def test_a_plain_image_has_none(self):
        assert features.feature_locations(np.full((48, 64), 90, np.uint8)).shape == (0, 2)


class TestFlow:
    def test_known_expansion_is_found_within_a_quarter_pixel(self):
        earlier, later = pairs.approach()
        start = features.feature_locations(earlier)
        end, ok = flow.track(earlier, later, start)
        back, back_ok = flow.track(later, earlier, end)
        keep = ok & back_ok & flow.distribution_filter(start, back)
        expected = np.array([320.0, 240.0]) + 1.04 * (start - [320.0, 240.0])
        assert keep.mean() > 0.9
        assert np.median(np.linalg.norm(end - expected, axis=1)[keep]) < 0.25

    def test_distribution_filter_is_strict_and_per_axis(self):
        start = np.zeros((4, 2))
        back = np.array([[0.49, 0.49], [0.5, 0.0], [0.0, -0.6], [-0.4, 0.1]])
        assert flow.distribution_filter(start, back, 0.5).tolist() == [True, False, False, True]

    def test_no_points_no_tracks(self):
        image = np.zeros((48, 64), np.uint8)
        end, ok = flow.track(image, image, np.zeros((0, 2)))
        assert end.shape == (0, 2)
        assert ok.shape == (0,)

    def test_derotated_start_is_where_a_pure_rotation_would_put_the_point(self):
        camera = CameraModel.from_hfov(640, 480, 70.0)
        yaw = np.radians(5.0)
        # Camera turns right by 5 degrees about y (down): a point ahead moves left by f tan 5.
        later_from_earlier = np.array(
            [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
        )
        ahead = np.array([[camera.cx_px, camera.cy_px]])
        moved = flow.derotate(ahead, camera, later_from_earlier)
        np.testing.assert_allclose(moved, ahead - [[camera.fx_px * np.tan(yaw), 0]], atol=1e-6)

    def test_tracks_say_which_shape_they_expected(self):
        with pytest.raises(ValueError, match=r"expected \(N, 2\), got \(3,\)"):
            flow.Tracks(np.zeros(3), np.zeros((3, 2)))
        with pytest.raises(ValueError, match="as many starts as ends"):
            flow.Tracks(np.zeros((2, 2)), np.zeros((3, 2)))

    def test_angles_lie_in_0_to_360(self):
        end = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, -1e-18]])
        assert flow.Tracks(np.zeros((5, 2)), end).angles_deg.tolist() == [0.0, 90.0, 180.0, 270.0, 0.0]


class TestOutliers:
    @pytest.mark.parametrize(("before", "after"), [(1725, 1553), (331, 298), (1192, 1073), (538, 485)])
    def test_length_filter_gives_the_counts_of_table_1(self, before, after):
        lengths = np.random.default_rng(0).random(before)
        kept = outliers.length_filter(lengths)
        assert kept.sum() == after
        assert lengths[~kept].max() < lengths[kept].min()

    def test_linear_statistics_split_angles_about_zero_and_circular_do_not(self):
        angles = np.array([358.0, 359.0, 1.0, 2.0])
        assert outliers.angle_spread(angles, "linear").mean_deg == 180.0
        circular = outliers.angle_spread(angles, "circular")
        assert min(circular.mean_deg, 360 - circular.mean_deg) < 1e-9
        assert circular.sigma_deg == pytest.approx(np.sqrt(2.5))

    def test_p_is_the_first_whose_widening_gains_less_than_the_share(self):
        # 80 survive 1 sigma, 95 survive 2 (a gain of 19 %), 100 survive 3 (5 %).
        spread = outliers.AngleSpread(0.0, 1.0, np.array([0.5] * 80 + [1.5] * 15 + [2.5] * 5))
        assert outliers.choose_p(spread, 0.10) == 3
        assert outliers.choose_p(spread, 0.20) == 2
        assert outliers.angular_filter(spread, 2).sum() == 95

    def test_p_ends_at_nine(self):
        growing = np.concatenate([[i + 0.5] * 2**i for i in range(9)])
        assert outliers.choose_p(outliers.AngleSpread(0.0, 1.0, growing), 0.10) == 9

    def test_a_field_without_spread_is_kept_whole(self):
        spread = outliers.angle_spread(np.full(7, 12.0))
        assert outliers.angular_filter(spread, outliers.choose_p(spread)).all()


class TestClusters:
    @pytest.mark.parametrize("n", [2, 7, 15])
    def test_kmeans_and_its_indices_agree_with_scikit_learn(self, n):
        points = samples()
        initial = literal.evenly_spaced(points, n)[0]
        ours = clusters.kmeans(points, initial)
        theirs = KMeans(n, init=initial, n_init=1, tol=0.0).fit(points)
        np.testing.assert_array_equal(ours.labels, theirs.labels_)
        np.testing.assert_allclose(ours.centres, theirs.cluster_centers_)
        assert ours.inertia == pytest.approx(theirs.inertia_)
        assert clusters.calinski_harabasz(points, ours) == pytest.approx(
            metrics.calinski_harabasz_score(points, ours.labels)
        )
        assert clusters.davies_bouldin(points, ours) == pytest.approx(
            metrics.davies_bouldin_score(points, ours.labels)
        )

    def test_an_empty_cluster_takes_the_furthest_sample(self):
        points = np.array([[0.0], [1.0], [2.0], [50.0]])
        result = clusters.kmeans(points, np.array([[1.0], [1000.0]]))
        assert sorted(result.centres[:, 0]) == [1.0, 50.0]

    def test_restarts_never_make_it_worse_and_the_seed_fixes_the_answer(self):
        points = samples()
        one, many = (clusters.best_of(points, 8, clusters.seeded_starts(3, r)) for r in (1, 8))
        assert many.inertia <= one.inertia
        again = clusters.best_of(points, 8, clusters.seeded_starts(3, 8))
        np.testing.assert_array_equal(many.centres, again.centres)

    def test_clear_blobs_are_counted(self):
        rng = np.random.default_rng(1)
        blobs = np.array([[100.0, 100, 0], [500, 100, 90], [300, 400, 270], [600, 450, 180]])
        points = np.repeat(blobs, 40, axis=0) + rng.normal(0, 4, (160, 3))
        assert clusters.choose_n(points, clusters.seeded_starts(0, 4)).n == 4

    def test_too_few_samples_are_refused(self):
        with pytest.raises(ValueError, match="at least 3 samples, got 2"):
            clusters.choose_n(np.zeros((2, 3)), clusters.seeded_starts(0, 1))

    def test_nearest_magnitudes_is_the_mean_of_the_k_nearest(self):
        ends = np.array([[0.0, 0], [1, 0], [2, 0], [9, 0]])
        got = clusters.nearest_magnitudes(np.array([[0.0, 0], [9, 1]]), ends, np.array([1.0, 2, 3, 10]), 2)
        assert got.tolist() == [1.5, 6.5]

    def test_k_stops_when_no_centre_changes_by_five_per_cent(self):
        ends = np.column_stack([np.arange(60.0), np.zeros(60)])
        centre = np.zeros((1, 2))
        steady = np.array([1.0] * 5 + [2.0] * 5 + [1.5] * 50)
        assert clusters.choose_k(centre, ends, np.ones(60)) == 10
        assert clusters.choose_k(centre, ends, steady) == 15
        assert clusters.choose_k(centre, ends, 2.0 ** np.arange(60)) == 40

    def test_plane_ratio_does_not_depend_on_scale(self):
        magnitudes = np.array([1.0, 2.0, 3.0])
        assert clusters.plane_ratio(magnitudes) == pytest.approx(clusters.plane_ratio(7 * magnitudes))
        assert clusters.plane_deviation(7 * magnitudes) == pytest.approx(7 * np.sqrt(2 / 3))


class TestLines:
    GATE = lines.AngleGate()
    SETTINGS = lines.HoughSettings(40, 30.0, 5.0)

    def drawn(self, *segments):
        import cv2

        image = np.full((360, 540), 80, np.uint8)
        for x1, y1, x2, y2 in segments:
            cv2.line(image, (x1, y1), (x2, y2), 220, 3)
        return image

    def test_only_the_lower_half_counts_and_is_given_in_full_image_pixels(self):
        found, total = lines.lower_half_lines(
            self.drawn((100, 10, 180, 150), (300, 200, 380, 340)), self.SETTINGS, self.GATE
        )
        assert 0 < len(found) <= total
        assert found[:, [1, 3]].min() >= 180
        assert found[:, [0, 2]].min() > 280

    def test_gate_and_vertical_gap(self):
        segments = np.array([[0, 0, 10, 1], [0, 0, 10, 10], [0, 0, 1, 20], [0, 0, -10, 10]], float)
        assert lines.gate(segments, self.GATE).tolist() == [False, True, True, True]
        assert lines.gate(segments, lines.AngleGate(vertical_gap_deg=10.0)).tolist() == [
            False,
            True,
            False,
            True,
        ]

    def test_no_line_is_an_empty_array(self):
        found, total = lines.lower_half_lines(self.drawn(), self.SETTINGS, self.GATE)
        assert found.shape == (0, 4)
        assert total == 0

    def test_adapting_the_votes_brings_the_number_near_to_the_wanted_one(self):
        image = self.drawn(*((20 + 14 * i, 190, 40 + 14 * i, 190 + 4 * (i + 4)) for i in range(34)))

        def number(votes, wanted):
            settings = lines.HoughSettings(votes, 12.0, 4.0)
            return len(lines.lower_half_lines(image, settings, self.GATE, wanted=wanted)[0])

        assert number(200, 0) < 10 <= number(200, 10)
        assert 10 <= number(5, 10) < number(5, 0)


class TestVanishingPoint:
    def towards(self, point, angles_deg, length=100.0):
        radians = np.radians(angles_deg)
        ray = np.column_stack([np.cos(radians), np.sin(radians)])
        return np.column_stack([point + 50 * ray, point + (50 + length) * ray])

    def test_lines_through_one_point_give_its_cell(self):
        segments = self.towards(np.array([312.0, 205.0]), [60, 70, 80])
        found = vanishing_point.candidates(segments, np.array([[300.0, 300]]), (640, 480))
        assert found.tolist() == [[315.0, 205.0]]

    def test_pairs_outside_5_to_15_degrees_do_not_count(self):
        point = np.array([312.0, 205.0])
        assert len(vanishing_point.intersections(self.towards(point, [60, 64]))) == 0
        assert len(vanishing_point.intersections(self.towards(point, [60, 76]))) == 0
        assert len(vanishing_point.intersections(self.towards(point, [60, 70]))) == 1
        assert len(vanishing_point.intersections(self.towards(point, [2, 172]))) == 1  # modulo 180

    def test_intersections_outside_the_image_do_not_count(self):
        near = np.array([0.0, 0.0])
        assert vanishing_point.fullest_cell(np.array([[-1.0, 5], [640.0, 5]]), (640, 480), near) is None

    def test_ties_go_to_the_cell_nearest_to_the_group(self):
        points = np.array([[15.0, 15.0], [605.0, 405.0]])
        cell = vanishing_point.fullest_cell(points, (640, 480), np.array([600.0, 400.0]))
        assert cell.tolist() == [605.0, 405.0]

    def test_one_candidate_a_cluster_at_most(self):
        left, right = np.array([104.0, 104.0]), np.array([504.0, 104.0])  # off the cells' borders
        segments = np.vstack([self.towards(left, [80, 90]), self.towards(right, [80, 90])])
        centres = np.array([[100.0, 200], [300, 10], [500, 200]])
        assert vanishing_point.candidates(segments, centres, (640, 480)).tolist() == [[105, 105], [505, 105]]


class TestVote:
    ENDS = np.array([[100.0, 100], [300, 100], [500, 100]])

    def elect(self, candidates, magnitudes):
        return vote.elect(
            np.array(candidates, float).reshape(-1, 2),
            np.array([100.0, 100]),
            magnitudes[0],
            self.ENDS,
            np.array(magnitudes),
            1,
        )

    def test_same_flow_within_five_per_cent_elects(self):
        assert self.elect([[300, 110]], [10.0, 10.4, 99.0]).tolist() == [300, 110]

    def test_other_flow_hides_the_vanishing_point(self):
        assert self.elect([[300, 110]], [10.0, 10.6, 99.0]) is None

    def test_only_the_nearest_candidate_is_examined(self):
        assert self.elect([[500, 110], [300, 110]], [10.0, 99.0, 10.0]) is None

    def test_no_candidate_none_elected(self):
        assert self.elect([], [10.0, 10.0, 10.0]) is None
