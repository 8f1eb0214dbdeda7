"""The benchmark measures what it says, on frames that are what it says. No assertion on speed."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector import bench, bench_frames, bench_paths
from detector.bench_frames import Stream, generated_stream, resized_stream, there_and_back
from detector.bench_memory import peak_memory
from detector.camera_model import CameraModel
from detector.cli import main
from detector.commands import inputs
from detector.commands.bench import _given, longest_run, table_of
from detector.drawing.performance import performance_chart
from detector.parallax.pipeline import ParallaxDetector
from detector.params import DetectorParams
from detector.two_view import reconstruct

OFFICE = Path(__file__).parents[1] / "data" / "pairs" / "office"
SMALL = (320, 240)
PARAMS = DetectorParams.preset(
    "default", kmeans_restarts=1, clusters_max=6, min_features=50, min_flow_vectors=50
)


@pytest.fixture(scope="module")
def figures():
    literal = bench.literal_reference()
    assert literal is not None
    return bench.run({SMALL: generated_stream(SMALL, 4)}, PARAMS, repeats=2, threads=(1, 2), literal=literal)


def test_every_series_is_measured_on_every_pair_and_thread_setting(figures):
    assert (figures["threads"], list(figures["more_threads"])) == (1, ["2"])
    for row in (figures["sizes"]["320x240"], figures["more_threads"]["2"]["320x240"]):
        assert row["samples"] == 2 * 2
        assert row["without_answer"] == dict.fromkeys(bench.SERIES, 0)
        for name in ("other", "parallax", "parallax_poses", "flow_balance", "line_vp"):
            assert row[f"{name}_over_floor"] > 0.0
        for name in bench.SERIES:
            assert 0.0 < row[f"{name}_s"]["median"] <= row[f"{name}_s"]["p95"]
            assert sum(row["answers"][name].values()) == 4
        assert {"frames", "features", "flow", "clusters", "lines"} <= set(row["steps"]["other"])
        for name in ("parallax", "parallax_poses"):
            assert {"frames", "first_look", "flow", "motion", "ranges", "map"} <= set(row["steps"][name])
        assert set(row["steps"]["sfm"]) == {"features", "matching", "essential", "triangulation"}
    assert figures["literal_n_init"] == PARAMS.kmeans_restarts
    counts = [each["n"] for each in figures["points"]]
    assert len(counts) == 2 * 5
    assert max(counts) > min(counts)
    assert counts[0] < 200 < counts[-1]


def test_with_the_processors_clock_waiting_is_not_counted(monkeypatch):
    ticks = iter(range(1_000_000))
    monkeypatch.setattr(bench, "CLOCKS", {"cpu": lambda: float(next(ticks))})
    found = bench.run({SMALL: generated_stream(SMALL, 3)}, PARAMS, repeats=1, threads=(1,), clock="cpu")
    assert found["clock"] == "cpu"
    row = found["sizes"]["320x240"]
    assert row["floor_s"]["median"] == 1.0  # two looks at that clock, and no other clock
    for loop in ("first", "other", "parallax"):
        assert all(step["median"] == int(step["median"]) for step in row["steps"][loop].values())


def test_steps_add_up_to_the_whole(figures):
    row = figures["sizes"]["320x240"]
    for name in ("first", "other", "parallax", "sfm"):
        steps = sum(step["median"] for step in row["steps"][name].values())
        assert 0.3 * row[f"{name}_s"]["median"] < steps < 2.0 * row[f"{name}_s"]["median"]


def test_ratios_are_medians_over_pairs_and_leave_out_what_has_no_answer():
    samples = bench.Samples()
    for literal, first in ((4.0, 1.0), (9.0, 3.0), (None, 1.0), (20.0, 2.0), (8.0, None)):
        samples.note("literal", literal, "x")
        samples.note("first", first, "x")
        for name in ("literal_other", "other", "parallax_poses", "line_vp", "sfm"):
            samples.note(name, None, "x")
    for parallax, rival, floor in (
        (6.0, 2.0, 2.0),
        (9.0, 1.0, 1.0),
        (None, 3.0, 1.0),
        (5.0, 1.0, None),
        (8.0, 5.0, 1.0),
    ):
        samples.note("parallax", parallax, "x")
        samples.note("flow_balance", rival, "x")
        samples.note("floor", floor, "x")
    row = bench._summary(samples, {"peak_mb": None})
    assert row["literal_over_first"] == 4.0
    assert (row["parallax_over_floor"], row["flow_balance_over_floor"]) == (8.0, 2.0)
    assert row["parallax_poses_over_floor"] is row["line_vp_over_floor"] is None
    assert row["literal_s"] == pytest.approx({"median": 8.5, "p95": np.percentile([4, 8, 9, 20], 95)})
    assert row["literal_over_other"] is None
    assert row["without_answer"]["literal"] == 1


def test_parallax_is_told_the_poses_where_there_are_any():
    with_poses = generated_stream(SMALL, 4)
    without = Stream(with_poses.frames)
    series = ("parallax", "parallax_poses", "flow_balance", "line_vp")
    ticks = iter(range(1_000_000))
    told, untold = (
        bench.measure(each, PARAMS, 1, series=series, clock=lambda: float(next(ticks)))
        for each in (with_poses, without)
    )
    assert untold.kinds["parallax_poses"] == {"not_run": 2}
    assert untold.seconds["parallax_poses"] == [None, None]
    assert None not in told.seconds["parallax_poses"]
    assert "not_run" not in told.kinds["parallax_poses"]
    for rival in ("flow_balance", "line_vp"):  # two looks at the clock, answered or not
        assert told.seconds[rival] == untold.seconds[rival] == [1.0, 1.0]
        assert sum(told.kinds[rival].values()) == 2


def test_the_motion_that_is_told_is_that_of_the_corridor(monkeypatch):
    told = []

    class Listening(ParallaxDetector):
        def detect(self, *frames, **given):
            told.append(given)
            return super().detect(*frames, **given)

    monkeypatch.setattr(bench_paths, "ParallaxDetector", Listening)
    bench.measure(generated_stream(SMALL, 3), PARAMS, 1, series=("parallax_poses",))
    for given in told:
        assert given["translation_earlier_m"] == pytest.approx([0.0, 0.0, 0.25])
        assert given["later_from_earlier"] == pytest.approx(np.eye(3))
        assert given["level_from_later"] @ [0.0, 1.0, 0.0] == pytest.approx([0.0, 0.0, 1.0])  # its z is down
        assert given["intrinsics"].source == "calibration"
    assert told


def test_outside_a_checkout_the_literal_figures_are_null(monkeypatch, tmp_path):
    monkeypatch.setattr(bench, "_LITERAL_FILE", tmp_path / "paper.py")
    assert bench.literal_reference() is None
    row = bench.run({SMALL: generated_stream(SMALL, 3)}, PARAMS, repeats=1, threads=(1,), literal=None)[
        "sizes"
    ]["320x240"]
    assert row["literal_s"] is row["literal_other_s"] is row["literal_over_first"] is None
    assert row["literal_over_other"] is None
    assert row["other_s"]["median"] > 0.0


def test_threads_are_as_they_were_afterwards():
    before = cv2.getNumThreads()
    with bench.limited_threads(1):
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


def test_memory_is_that_of_a_process_with_nothing_else_in_it():
    ballast = np.ones(400_000_000 // 8)  # more than the whole of the other process, were it counted
    found = peak_memory(generated_stream(SMALL, 3), PARAMS)
    assert ballast.sum() > 0
    assert found["peak_mb"] is not None
    assert found["peak_imports_mb"] is not None
    assert 20.0 < found["peak_imports_mb"] <= found["peak_mb"] < 380.0


def test_the_generated_corridor_is_repeatable_and_moves_as_it_says():
    first, second = generated_stream((480, 360), 3), generated_stream((480, 360), 3)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    camera = CameraModel.from_hfov(480, 360, 80.0)
    found = reconstruct(first[0], first[1], camera)
    assert found.failure is None
    assert math.degrees(math.acos(min(1.0, found.translation_earlier[2]))) < 3.0
    with pytest.raises(ValueError, match="two frames"):
        generated_stream(SMALL, 1)


def test_given_frames_keep_their_shape_when_resized():
    frame = np.zeros((360, 540), np.uint8)
    cv2.circle(frame, (270, 180), 90, 255, cv2.FILLED)
    for size in ((640, 480), (1280, 720), (200, 400)):
        (found,) = resized_stream(Stream((frame,)), size)
        assert found.shape == size[::-1]
        rows, columns = np.flatnonzero(found.max(axis=1) > 127), np.flatnonzero(found.max(axis=0) > 127)
        if len(columns) < size[0]:  # not cut off at the sides
            assert len(rows) == pytest.approx(len(columns), abs=3)


def test_a_pair_becomes_a_stream_there_and_back():
    a, b, c = (np.full((2, 2), value, np.uint8) for value in (1, 2, 3))
    poses = tuple(bench_frames.CameraPose(np.eye(3), np.full(3, float(value))) for value in (1, 2, 3))
    assert [int(frame[0, 0]) for frame in there_and_back(Stream((a, b)), 5)] == [1, 2, 1, 2, 1]
    walk = there_and_back(Stream((a, b, c), None, poses), 6)
    assert [int(frame[0, 0]) for frame in walk] == [1, 2, 3, 2, 1, 2]
    assert [int(pose.position_m[0]) for pose in walk.poses] == [1, 2, 3, 2, 1, 2], "poses go along"
    assert len(there_and_back(Stream((a, b, c)), 2)) == 3
    with pytest.raises(ValueError, match="expected 2 poses"):
        Stream((a, b), None, poses)


def test_a_camera_is_cut_and_resized_with_its_frames():
    camera = CameraModel(540, 360, 500.0, 510.0, 260.0, 190.0)
    seen = np.array([[0.05, -0.08, 1.0]])
    frame = np.zeros((360, 540), np.uint8)
    x, y = camera.ray_to_pixel(seen)[0]
    cv2.circle(frame, (round(x), round(y)), 12, 255, cv2.FILLED)
    for size in ((640, 480), (300, 200)):
        found = resized_stream(Stream((frame,), camera), size)
        (rows, columns), (x_px, y_px) = np.nonzero(found[0] > 127), found.camera.ray_to_pixel(seen)[0]
        assert (found.camera.width_px, found.camera.height_px) == size
        assert (columns.mean(), rows.mean()) == pytest.approx((x_px, y_px), abs=1.0)


def test_the_longest_run_of_pairs():
    assert longest_run([("1", "2"), ("5", "6"), ("6", "7"), ("7", "8"), ("9", "10")]) == ["5", "6", "7", "8"]
    assert longest_run([]) == []


def test_a_folder_is_a_walk_or_the_longest_run_of_its_pairs(tmp_path):
    folder = tmp_path / "walk" / "images"
    folder.mkdir(parents=True)
    for index, frame in enumerate(generated_stream((80, 60), 5)):
        cv2.imwrite(str(folder / f"{index}.png"), frame)
    walk, source = _given([folder], 4)
    assert (len(walk), source) == (4, "walk, 4 frames, resized")
    assert (walk.camera, walk.poses) == (None, ())
    pairs = [{"a": f"images/{a}.png", "b": f"images/{b}.png"} for a, b in ((4, 3), (0, 1), (1, 2))]
    frames = {f"images/{index}.png": {} for index in range(5)}
    truth = {"image_size": [80, 60], "K": None, "frames": frames, "pairs": pairs}
    (tmp_path / "walk" / "groundtruth.json").write_text(json.dumps(truth))
    walk, source = _given([tmp_path / "walk"], 10)
    assert source == "walk, 3 frames, resized"
    assert np.array_equal(walk[2], inputs.read_image(folder / "2.png"))
    assert walk.poses == ()
    for index, frame in enumerate(frames.values()):
        frame["pose"] = [[0, 0, 1, index], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    truth |= {"K": [[50.0, 0, 40.0], [0, 50.0, 30.0], [0, 0, 1]]}
    (tmp_path / "walk" / "groundtruth.json").write_text(json.dumps(truth))
    for given in (tmp_path / "walk", folder):
        walk, _ = _given([given], 3)
        assert [pose.position_m[0] for pose in walk.poses] == [0.0, 1.0, 2.0]
        assert walk.camera.fx_px == 50.0
    del frames["images/1.png"]["pose"]  # a motion is that between two poses
    (tmp_path / "walk" / "groundtruth.json").write_text(json.dumps(truth))
    assert _given([tmp_path / "walk"], 3)[0].poses == ()
    truth["image_size"] = [160, 120]
    (tmp_path / "walk" / "groundtruth.json").write_text(json.dumps(truth))
    with pytest.raises(inputs.InputError, match="found 80 x 60 px, its K is for 160 x 120"):
        _given([tmp_path / "walk"], 3)


def test_the_command_prints_json_and_draws(capsys, tmp_path):
    images = [str(OFFICE / name) for name in ("00184.jpg", "00185.jpg")]
    plot = tmp_path / "plot.png"
    code = main(
        [
            "bench",
            *images,
            "--size",
            "360x240",
            "--repeats",
            "1",
            "--threads",
            "1",
            "--json",
            "--plot",
            str(plot),
        ]
    )
    out = capsys.readouterr().out
    assert code == 0
    found = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert list(found["sizes"]) == ["360x240"]
    assert found["frames"] == "00184.jpg and 00185.jpg there and back, resized"
    assert {"threads", "machine", "sizes"} <= set(found)
    assert cv2.imread(str(plot)).shape[1] > 1000
    row = found["sizes"]["360x240"]
    assert row["parallax_poses_s"] is None, "two images have no poses"
    assert row["answers"]["parallax_poses"] == {"not_run": row["samples"]}
    head, _, first, *_ = (line.split(" | ") for line in table_of(found).splitlines())
    cells = dict(zip(head, first, strict=True))
    assert cells["| size"] == "| 360 x 240"
    assert cells["parallax with poses, p95"] == "-, -"
    assert (
        cells["line VP, p95"]
        == f"{1e3 * row['line_vp_s']['median']:.1f}, {1e3 * row['line_vp_s']['p95']:.1f}"
    )
    assert (
        cells["flow balance, line VP / floor"]
        == f"{row['flow_balance_over_floor']:.1f}, {row['line_vp_over_floor']:.1f}"
    )


def test_a_chart_without_literal_and_points_is_drawn(figures):
    bare = json.loads(json.dumps(figures))
    bare["points"] = []
    for row in bare["sizes"].values():
        row["literal_s"] = row["literal_other_s"] = row["parallax_poses_s"] = None
    picture = performance_chart(bare)
    assert picture.std() > 1.0
    rivals = json.loads(json.dumps(bare))
    for row in rivals["sizes"].values():
        row["flow_balance_s"] = None
    assert (performance_chart(rivals) != picture).any()


AT_THE_LEFT_EDGE = {
    "image_size": [320, 240],
    "K": [[300.0, 0.0, 20.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]],
    "frames": [{"file": "1.png"}, {"file": "2.png"}],
}
"""Its principal point is cut off where frames are cut to a narrow shape."""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{there}"], "allowed are two images or one folder"),
        (["a.png"], "a.png: cannot be read"),
        (["--plot", "no/such/plot.png"], "--plot no/such/plot.png: no/such is not a folder"),
        (["--plot", "plot.xyz"], "found the ending '.xyz'"),
        (["no/such.png", "b.png"], "cannot be read"),
        (["{empty}"], "found 0 images"),
        (["--preset", "nobody"], "allowed are default, paper"),
        (["--size", "64x64", "--params", "{strict}"], "--size 64x64"),
        (["{torn}"], "poses.json: is not valid JSON"),
        (["{aside}", "--size", "100x400", "--repeats", "1"], "K: cx_px: found -"),
    ],
)
def test_bad_input_is_one_clear_line(capsys, tmp_path, arguments, words):
    (tmp_path / "strict.toml").write_text("min_width_px = 100\n")
    for folder, known in (
        ("torn", "{"),
        ("aside", json.dumps(AT_THE_LEFT_EDGE)),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "poses.json").write_text(known)
        for index in (1, 2):
            cv2.imwrite(str(tmp_path / folder / f"{index}.png"), np.full((240, 320), 90, np.uint8))
    named = [
        each.format(
            empty=tmp_path / "none",
            strict=tmp_path / "strict.toml",
            torn=tmp_path / "torn",
            aside=tmp_path / "aside",
            there=OFFICE / "00184.jpg",
        )
        for each in arguments
    ]
    (tmp_path / "none").mkdir()
    assert main(["bench", *named]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("size", ["640", "0x480", "640x99999", "x"])
def test_a_size_that_cannot_be_is_refused(size, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["bench", "--size", size])
    assert stop.value.code == 2
    assert "allowed is WIDTHxHEIGHT" in capsys.readouterr().err
