"""``detector report --method parallax``: its own figures and numbers, which are the method's own answer."""

import json
import math

import cv2
import numpy as np
import pytest

from detector.camera_model import CameraModel
from detector.cli import main
from detector.drawing.parallax_figures import flow_figure
from detector.parallax.pipeline import Intrinsics, ParallaxDetector
from tests.detector.commands.test_report import BRICKS, OFFICE, report_of


def run(capsys, *arguments):
    code = main(["report", *map(str, arguments), "--method", "parallax", "--loops", "1"])
    out, err = capsys.readouterr()
    return code, out, err


def test_figures_and_numbers_of_one_pair(capsys, tmp_path):
    (tmp_path / "figure-3.png").write_bytes(b"of another method")
    code, out, err = run(capsys, *OFFICE, "-o", tmp_path, "--hfov", "70", "--interval", "0.5")
    assert (code, err) == (0, "")
    assert out.strip() == str(tmp_path / "report.md")
    assert not (tmp_path / "figure-3.png").exists()
    report = report_of(tmp_path)
    assert list(report["pictures"]) == ["flow", "ranges", "map", "polar"]
    text = (tmp_path / "report.md").read_text()
    for file in report["pictures"].values():
        assert min(cv2.imread(str(tmp_path / file)).shape[:2]) > 400
        assert f"({file})" in text

    images = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in OFFICE]
    camera = CameraModel.from_hfov(540, 360, 70.0)
    found = ParallaxDetector().detect(*images, intrinsics=Intrinsics(camera, "field_of_view"))
    answer = report["answer"]
    assert answer["kind"] == found.detection.kind.value
    assert answer["x_px"] == pytest.approx(found.detection.x_px)
    assert answer["time_to_contact_s"] == pytest.approx(0.5 * found.detection.time_to_contact.frames)
    assert (report["motion"]["intrinsics_source"], report["motion"]["rotation_source"]) == (
        "field_of_view",
        "flow",
    )
    assert "`field_of_view`" in text
    assert report["samples"]["believed"] == int(found.field.believed.sum())
    assert report["map"]["unit"] == "baselines"
    assert len(report["map"]["directions"]) == int(found.decision.void_map.known.sum())
    assert report["gap"]["free"] == pytest.approx(found.decision.gap.free_m)
    assert set(report["seconds"]["steps"]) == {
        "frames",
        "first_look",
        "first_motion",
        "sweep",
        "flow",
        "motion",
        "plane",
        "ranges",
        "map",
    }


def test_with_the_motion_it_speaks_of_metres(capsys, tmp_path):
    rotation = tmp_path / "rotation.json"
    rotation.write_text(json.dumps({"later_from_earlier": np.eye(3).tolist()}))
    arguments = [*BRICKS, "-o", tmp_path, "--hfov", "60", "--rotation", rotation]
    assert run(capsys, *arguments, "--translation", "0", "0", "0.05")[0] == 0
    report = report_of(tmp_path)
    assert report["answer"]["kind"] == "single_plane"
    assert report["map"]["unit"] == "m"
    assert report["answer"]["distance_m"] == pytest.approx(0.05 * report["answer"]["time_to_contact_frames"])
    assert report["motion"]["rotation_source"] == "attitude_refined"
    assert report["side_by_side"]["told"] == ["camera", "rotation", "translation"]
    row = report["side_by_side"]["methods"][1]
    assert (row["method"], row["kind"], row["right"]) == ("parallax", "single_plane", True)
    assert row["confidence"] == report["answer"]["confidence"]
    assert "## Side by side" in (tmp_path / "report.md").read_text()
    assert "single_plane" in (tmp_path / "report.md").read_text()


def test_a_pair_that_stands_still_has_no_map_and_says_why(capsys, tmp_path):
    (tmp_path / "polar.png").write_bytes(b"of another pair")
    assert run(capsys, OFFICE[0], OFFICE[0], "-o", tmp_path)[0] == 0
    report = report_of(tmp_path)
    assert (report["answer"]["kind"], report["answer"]["reason"]) == ("none", "no_motion")
    assert list(report["pictures"]) == ["flow"]
    assert not (tmp_path / "polar.png").exists()
    assert (report["map"], report["gap"], report["motion"]) == (None, None, None)
    assert "ranges, map, polar" in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--translation", "0", "0", "1"], "--translation: needs --rotation"),
        (["--translation", "0", "nan", "1"], "allowed are metres"),
        (["--interval", "0"], "allowed are seconds"),
    ],
)
def test_one_clear_line_for_what_cannot_be_used(capsys, tmp_path, arguments, words):
    try:
        code = main(["report", *OFFICE, "-o", str(tmp_path / "new"), "--method", "parallax", *arguments])
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_pictures_too_small_for_any_camera_are_refused(capsys, tmp_path):
    tiny = tmp_path / "tiny.png"
    cv2.imwrite(str(tiny), np.full((8, 8), 90, np.uint8))
    code, out, err = run(capsys, tiny, tiny, "-o", tmp_path / "new")
    assert (code, out) == (2, "")
    assert err.splitlines() == [f"detector: error: {tiny}: found 8 x 8 px, needed are 16 x 16 and more"]


def test_settings_of_one_method_are_refused_by_the_other(capsys, tmp_path):
    assert main(["report", *OFFICE, "-o", str(tmp_path), "--interval", "1"]) == 2
    assert "--interval: only with --method parallax" in capsys.readouterr().err


def test_the_flow_figure_shows_what_is_not_believed_apart():
    images = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in OFFICE]
    result = ParallaxDetector().detect(*images)
    picture = flow_figure(images[1], result.field, result.geometry)
    red = (picture[..., 2].astype(int) - picture[..., 0] > 120).sum()
    assert red > 50
    assert math.isfinite(result.geometry.motion.direction_sigma_rad)
