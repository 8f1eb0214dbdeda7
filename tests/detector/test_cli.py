"""``detector detect``: an answer for people and for programs, and one clear line for input that cannot be used."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.cli import main
from detector.params import DetectorParams
from detector.pipeline import VoidDetector

PAIRS = Path(__file__).parents[1] / "data" / "pairs"
OFFICE = [str(PAIRS / "office" / name) for name in ("00068.jpg", "00069.jpg")]
BRICKS = [str(PAIRS / "brickwall" / name) for name in ("001.jpg", "003.jpg")]
KEYS = {
    "kind", "x_px", "y_px", "reason", "detail", "time_to_contact_frames", "time_to_contact_spread_frames",
    "time_to_contact_samples", "time_to_contact_s", "time_to_contact_spread_s", "distance_m", "distance_spread_m",
    "confidence", "diagnostics",
}  # fmt: skip


def run(capsys, *arguments):
    code = main(["detect", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def answer(capsys, *arguments):
    code, out, err = run(capsys, *arguments, "--json")
    assert code == 0, err
    assert err == ""
    return json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))


def rotation_of(first, second):
    poses = json.loads((PAIRS / "office" / "poses.json").read_text())["poses"]
    a, b = np.array(poses[first]), np.array(poses[second])
    return (b[:3, :3].T @ a[:3, :3]).tolist()


@pytest.fixture
def camera(tmp_path):
    k = json.loads((PAIRS / "office" / "poses.json").read_text())["K"]
    path = tmp_path / "camera.toml"
    path.write_text(
        f"width_px = 540\nheight_px = 360\nfx_px = {k[0][0]}\nfy_px = {k[1][1]}\ncx_px = {k[0][2]}\ncy_px = {k[1][2]}\n"
        "distortion = []\n"
    )
    return path


@pytest.fixture
def rotation(tmp_path):
    path = tmp_path / "rotation.json"
    path.write_text(json.dumps({"later_from_earlier": rotation_of("00184.jpg", "00185.jpg")}))
    return path


def test_a_wall_is_a_single_plane_with_its_time_and_metres(capsys):
    found = answer(capsys, *BRICKS, "--baseline", "0.25", "--interval", "0.2")
    assert set(found) == KEYS
    assert found["time_to_contact_s"] == pytest.approx(0.2 * found["time_to_contact_frames"])
    assert found["time_to_contact_spread_s"] == pytest.approx(0.2 * found["time_to_contact_spread_frames"])
    assert (found["kind"], found["x_px"], found["reason"]) == ("single_plane", None, None)
    assert found["distance_m"] == pytest.approx(0.25 * found["time_to_contact_frames"])
    assert found["time_to_contact_samples"] > 20
    assert found["diagnostics"]["n_after_angle"] >= 100
    assert set(found["diagnostics"]["seconds"]) >= {"features", "flow", "clusters"}


def test_the_answer_is_the_detectors_own_with_the_preset_asked_for(capsys):
    images = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in OFFICE]
    for preset in ("paper", "default"):
        found = answer(capsys, *OFFICE, "--preset", preset)
        direct = VoidDetector(DetectorParams.preset(preset)).detect(*images).detection
        assert found["diagnostics"]["n_after_angle"] == direct.diagnostics.n_after_angle
        assert found["diagnostics"]["n"] == direct.diagnostics.n


def test_a_rotation_from_json_or_toml_is_taken_out_of_the_flow(capsys, camera, rotation, tmp_path):
    office = [str(PAIRS / "office" / name) for name in ("00184.jpg", "00185.jpg")]
    plain = answer(capsys, *office, "--camera", camera)
    turned = answer(capsys, *office, "--camera", camera, "--rotation", rotation)
    rows = json.loads(rotation.read_text())["later_from_earlier"]
    toml = tmp_path / "rotation.toml"
    toml.write_text(f"later_from_earlier = {rows}\n")
    again = answer(capsys, *office, "--camera", camera, "--rotation", toml)
    assert turned["diagnostics"]["median_flow_px"] < 0.8 * plain["diagnostics"]["median_flow_px"]
    assert again["diagnostics"]["median_flow_px"] == turned["diagnostics"]["median_flow_px"]


def test_people_get_a_short_answer_and_a_plot(capsys, tmp_path):
    plot = tmp_path / "answer.png"
    code, out, err = run(capsys, *BRICKS, "--plot", plot)
    assert (code, err) == (0, "")
    assert out.startswith("SINGLE PLANE, contact in")
    assert len(out.splitlines()) < 10
    assert cv2.imread(str(plot)).shape == (512, 512, 3), "a small frame is enlarged"


def test_too_small_frames_and_different_sizes_are_an_answer(capsys, tmp_path):
    small, other = tmp_path / "small.png", tmp_path / "other.png"
    cv2.imwrite(str(small), np.zeros((1, 1), np.uint8))
    cv2.imwrite(str(other), np.full((48, 64), 99, np.uint8))
    for pair in ((small, small), (small, other), (OFFICE[0], other)):
        found = answer(capsys, *pair, "--hfov", "70")
        assert (found["kind"], found["reason"]) == ("none", "wrong_size")
        assert found["detail"]
    assert run(capsys, small, small, "--plot", tmp_path / "p.png")[0] == 0


def test_single_parameters_can_be_replaced(capsys, tmp_path):
    params = tmp_path / "params.toml"
    params.write_text("min_features = 90000\n")
    found = answer(capsys, *OFFICE, "--params", params)
    assert (found["kind"], found["reason"]) == ("none", "too_few_features_earlier")


def bad_rotations():
    return {
        "not text": b"\xff\xfe\x00",
        "not TOML": b"later_from_earlier = [[",
        "not JSON": b'{"later_from_earlier": ',
        "another key": b"rotation = [[1,0,0],[0,1,0],[0,0,1]]",
        "two rows": b"later_from_earlier = [[1,0,0],[0,1,0]]",
        "words": b'later_from_earlier = [["a",0,0],[0,1,0],[0,0,1]]',
        "stretched": b"later_from_earlier = [[2,0,0],[0,1,0],[0,0,1]]",
        "mirrored": b"later_from_earlier = [[-1,0,0],[0,1,0],[0,0,1]]",
        "not a number": b"later_from_earlier = [[nan,0,0],[0,1,0],[0,0,1]]",
    }


@pytest.mark.parametrize("name", bad_rotations())
def test_a_rotation_that_is_none_is_one_clear_line(capsys, tmp_path, name):
    path = tmp_path / "rotation.toml"
    path.write_bytes(bad_rotations()[name])
    code, out, err = run(capsys, *OFFICE, "--hfov", "60", "--rotation", path)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "rotation.toml" in err


def test_input_that_cannot_be_used_is_one_clear_line(capsys, tmp_path, rotation):
    text = tmp_path / "text.png"
    text.write_text("no image")
    empty = tmp_path / "empty.png"
    empty.touch()
    bad = tmp_path / "bad.toml"
    bad.write_text("no_such_key = 1\n")
    for arguments, words in (
        ((tmp_path / "none.png", OFFICE[1]), "none.png"),
        ((tmp_path, OFFICE[1]), str(tmp_path)),
        ((OFFICE[0], text), "text.png"),
        ((OFFICE[0], empty), "empty.png"),
        ((*OFFICE, "--preset", "best"), "preset"),
        ((*OFFICE, "--params", bad), "no_such_key"),
        ((*OFFICE, "--params", tmp_path / "gone.toml"), "gone.toml"),
        ((*OFFICE, "--camera", bad), "bad.toml"),
        ((*OFFICE, "--hfov", "400"), "--hfov"),
        ((*OFFICE, "--rotation", rotation), "--rotation"),
        ((*BRICKS, "--plot", tmp_path / "no" / "folder.png"), "folder.png"),
        ((*BRICKS, "--plot", tmp_path / "plot.words"), "plot.words"),
    ):
        code, out, err = run(capsys, *arguments)
        assert (code, out) == (2, ""), arguments
        assert len(err.splitlines()) == 1, err
        assert words in err, err


@pytest.mark.parametrize("baseline", ["0", "-1", "nan", "far"])
def test_a_baseline_that_is_no_distance_is_refused(capsys, baseline):
    with pytest.raises(SystemExit) as exit_:
        main(["detect", *BRICKS, "--baseline", baseline])
    assert exit_.value.code == 2
    assert "--baseline" in capsys.readouterr().err


def test_help_does_not_import_opencv():
    code = "import sys, detector.cli; sys.exit('cv2' in sys.modules or 'sklearn' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_a_reader_that_has_seen_enough_is_no_error():
    code = f"import sys; from detector.cli import main; sys.exit(main(['detect', *{OFFICE!r}, '--json']))"
    command = f'{sys.executable} -c "{code}" | true; echo "${{PIPESTATUS[0]}}"'
    done = subprocess.run(["/bin/bash", "-c", command], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    assert done.stdout.strip() == "1"
