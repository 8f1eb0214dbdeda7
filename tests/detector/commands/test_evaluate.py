"""``detector evaluate``: figures for people and for programs, files, and one clear line for input that cannot be used."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.cli import main

PAIRS = Path(__file__).parents[2] / "data" / "pairs"
OFFICE, BRICKS = PAIRS / "office", PAIRS / "brickwall"
KEYS = {
    "name", "method", "preset", "changes", "images", "poses", "loops", "pairs", "kinds", "reasons", "direction", "foe", "single_plane",
    "no_motion", "vanishing_point", "time_to_contact", "seconds", "per_pair", "per_frame",
}  # fmt: skip


def run(capsys, *arguments):
    code = main(["evaluate", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def evaluated(capsys, *arguments):
    code, out, err = run(capsys, *arguments, "--json")
    assert code == 0, err
    assert err == ""
    found = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert isinstance(found, list)
    return found


def test_one_object_a_set_with_the_keys_of_the_documentation(capsys):
    office, bricks = evaluated(capsys, OFFICE, BRICKS)
    assert set(office) == set(bricks) == KEYS
    assert (office["name"], office["method"], office["preset"], office["pairs"]) == (
        "office",
        "paper",
        "default",
        5,
    )
    assert (office["poses"], bricks["poses"]) == ("full", "none")
    assert sum(office["kinds"].values()) == 5
    assert {
        "answered",
        "with_truth",
        "right",
        "in_box",
        "median_error_width",
        "median_error_deg",
        "median_profile_ratio",
    } <= set(office["direction"])
    assert {"tp", "fp", "fn", "tn"} <= set(office["single_plane"])
    assert {"n", "median_px"} == set(office["foe"])
    assert {"with_truth", "within_tenth_width"} <= set(office["vanishing_point"])
    assert {"n", "median_relative_error"} <= set(office["time_to_contact"])
    assert {"median", "p95"} == set(office["seconds"])
    assert [pair["b"] for pair in bricks["per_pair"]] == ["003.jpg", "035.jpg", "063.jpg"]
    plane = bricks["single_plane"]
    assert plane["tp"] + plane["fn"] == 3
    documented = (Path(__file__).parents[3] / "docs" / "evaluation.md").read_text()
    assert all(f"`{key}`" in documented for key in KEYS | {"comparison"})
    for key in (*office["per_pair"][0], *office["direction"], *office["single_plane"]):
        assert f"`{key}`" in documented, key


def test_for_people_it_is_a_markdown_table(capsys):
    code, out, err = run(capsys, BRICKS, "--method", "straight")
    assert (code, err) == (0, "")
    header, rule, row = out.splitlines()[:3]
    assert header.startswith("| set | method |")
    assert set(rule) <= set("|- ")
    assert row.startswith("| brickwall | straight | default | nothing | 3 |")
    assert header.count("|") == rule.count("|") == row.count("|")
    assert "3 straight_ahead" in out


def test_what_the_method_is_told_changes_its_answers(capsys):
    told, turned, untold = (
        evaluated(capsys, OFFICE, *flags)[0] for flags in ((), ("--rotation-only",), ("--no-poses",))
    )
    assert [item["poses"] for item in (told, turned, untold)] == ["full", "rotation", "none"]
    # The translation that was told is no estimate: the focus is that of the flow either way.
    assert told["foe"] == turned["foe"]
    assert turned["foe"]["n"] > 0
    assert untold["kinds"] != told["kinds"]


def test_a_second_run_with_one_change_is_compared(capsys):
    (office,) = evaluated(capsys, OFFICE, "--compare", "preset=paper")
    found = office["comparison"]
    assert found["with"] == "preset=paper"
    assert found["against"]["preset"] == "paper"
    assert found["against"] == {
        key: value
        for key, value in evaluated(capsys, OFFICE, "--preset", "paper")[0].items()
        if key in found["against"]
    } | {"seconds": found["against"]["seconds"], "vanishing_point": found["against"]["vanishing_point"]}
    assert found["agreement"]["pairs"] == 5
    false_planes = next(figure for figure in found["figures"] if figure["name"] == "false planes")
    plane = office["single_plane"]
    assert false_planes["first"] == pytest.approx(plane["fp"] / (plane["fp"] + plane["tn"]))


def test_a_parameter_can_be_the_change(capsys):
    (office,) = evaluated(capsys, OFFICE, "--compare", "min_features=100000", "--compare", "poses=none")
    against = office["comparison"]["against"]
    assert against["kinds"] == {"none": 5}
    assert against["poses"] == "none"
    assert against["reasons"] == {"too_few_features_earlier": 5}


def test_single_parameters_are_replaced_and_named(capsys, tmp_path):
    (tmp_path / "params.toml").write_text("min_features = 100000\nseed = 3")
    (office,) = evaluated(
        capsys, OFFICE, "--params", tmp_path / "params.toml", "--set", "seed=0", "--compare", "preset=paper"
    )
    assert office["changes"] == {"min_features": 100000}
    assert office["kinds"] == {"none": 5}
    against = office["comparison"]["against"]
    assert (against["preset"], against["changes"]) == ("paper", {"min_features": 100000})


def test_files_are_written_and_can_be_compared_with_later(capsys, tmp_path):
    out = tmp_path / "made" / "here"
    code, text, err = run(capsys, OFFICE, "--method", "straight", "-o", out)
    assert (code, err) == (0, "")
    assert (out / "evaluation.md").read_text() == text
    saved = json.loads((out / "evaluation.json").read_text())
    assert saved[0]["kinds"] == {"straight_ahead": 5}
    sheet = cv2.imread(str(out / "worst-office.png"))
    assert sheet is not None
    assert sheet.shape[1] % 360 == 0
    assert not (out / "comparison.json").exists()
    code, text, _ = run(
        capsys, OFFICE, "--method", "straight", "--compare", out / "evaluation.json", "-o", out
    )
    assert code == 0
    compared = json.loads((out / "comparison.json").read_text())
    assert compared["all"]["agreement"]["same_answer"] == 5
    assert "no difference shown" in text


def test_a_share_of_known_depth_and_a_baseline_choose_the_pairs(capsys):
    (office,) = evaluated(capsys, OFFICE, "--method", "straight", "--min-valid-frac", "0.6")
    assert 0 < office["pairs"] < 5
    assert all(pair["valid_frac"] >= 0.6 for pair in office["per_pair"])
    (formed,) = evaluated(capsys, OFFICE, "--method", "straight", "--min-baseline", "0.09")
    assert all(pair["baseline_m"] >= 0.09 for pair in formed["per_pair"])
    assert ("00184.jpg", "00185.jpg") in [(pair["a"], pair["b"]) for pair in formed["per_pair"]]


def test_a_walk_needs_a_baseline_and_takes_truth_from_another_set(capsys, tmp_path):
    table = json.loads((OFFICE / "groundtruth.json").read_text())
    frames = [{"file": name, "pose": frame["pose"]} for name, frame in table["frames"].items()]
    for path in OFFICE.glob("*.jpg"):
        shutil.copy(path, tmp_path)
    walk = {key: table[key] for key in ("image_size", "K")} | {"name": "walk", "frames": frames}
    (tmp_path / "poses.json").write_text(json.dumps(walk))
    code, _, err = run(capsys, tmp_path)
    assert code == 2
    assert "--min-baseline M forms pairs from the poses" in err
    plain, joined = (
        evaluated(capsys, tmp_path, "--method", "straight", "--min-baseline", "0.1", *more)[0]
        for more in ((), ("--truth", OFFICE))
    )
    assert plain["pairs"] == joined["pairs"] > 0
    assert plain["direction"]["with_truth"] == 0
    assert joined["direction"]["with_truth"] == joined["pairs"]


def test_stills_are_judged_by_their_lines(capsys, tmp_path):
    image = np.full((480, 640), 90, np.uint8)
    for slope in (-0.9, -0.65, 0.65, 0.9):
        cv2.line(image, (320, 245), (round(320 + 235 * slope), 480), 200, 3, cv2.LINE_AA)
    cv2.imwrite(str(tmp_path / "still.png"), image)
    table = {
        "name": "stills",
        "image_size": [640, 480],
        "frames": {"still.png": {"vp": [320, 245]}},
        "pairs": [],
    }
    (tmp_path / "groundtruth.json").write_text(json.dumps(table))
    (found,) = evaluated(capsys, tmp_path, "--preset", "paper")
    assert (found["pairs"], found["vanishing_point"]["with_truth"]) == (0, 1)
    assert found["vanishing_point"]["within_tenth_width"] == 1
    assert found["seconds"] == {"median": None, "p95": None}


def test_a_grid_of_positions_has_answers_and_no_truth(capsys, tmp_path):
    for index, name in enumerate(("068", "069")):
        image = cv2.imread(str(OFFICE / f"00{name}.jpg"))
        cv2.imwrite(str(tmp_path / f"{index}_4_FRONT_LEFT.png"), image)
    (found,) = evaluated(capsys, tmp_path)
    assert (found["pairs"], found["per_pair"][0]["a"]) == (1, "0_4_FRONT_LEFT.png")
    assert found["direction"]["with_truth"] == 0
    (back,) = evaluated(capsys, tmp_path, "--grid-front", "row-")
    assert back["per_pair"][0]["a"] == "1_4_FRONT_LEFT.png"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{missing}"], "is not a folder"),
        (["{empty}"], "holds neither groundtruth.json nor poses.json"),
        (["{broken}"], "is not valid JSON"),
        (
            ["{office}", "--method", "best"],
            "--method: found 'best', allowed are paper, parallax, straight, flow_balance, line_vp",
        ),
        (["{office}", "--preset", "best"], "preset: found 'best'"),
        (["{office}", "--derotated"], "has no b_derot"),
        (["{bricks}", "--min-baseline", "0.2"], "needs the pose of every frame"),
        (["{office}", "--min-baseline", "9"], "no two frames lie 9 m apart"),
        (["{office}", "--min-valid-frac", "0.99"], "no later depth image is known in a share of 0.99"),
        (["{office}", "--compare", "best=1"], "--compare: best: unknown key"),
        (["{office}", "--compare", "seed=x"], "--compare: seed: found 'x'"),
        (["{office}", "--set", "seed=x"], "--set: seed: found 'x'"),
        (["{office}", "--set", "seed"], "--set: found 'seed', needed is KEY=VALUE"),
        (["{office}", "--compare", "preset=x"], "--compare: preset: found 'x'"),
        (["{office}", "--compare", "method=x"], "--compare: method: found 'x', allowed are paper"),
        (["{office}", "--compare", "poses=x"], "--compare: poses: found 'x', allowed are full"),
        (["{office}", "--compare", "{missing}"], "cannot be read"),
        (["{office}", "--compare", "{office}/groundtruth.json"], "found no list of evaluations"),
        (["{office}", "--compare", "{other}"], "--compare: evaluations of office and of else"),
        (["{office}", "--compare", "{other}", "--compare", "seed=1"], "a file goes alone"),
        (["{office}", "--truth", "{bricks}"], "has no frame of the same name"),
        (["{office}", "-o", "{file}"], "cannot be made"),
        (["{nopicture}"], "gone.png: cannot be read"),
        (["{grid}", "--grid-front", "up"], "--grid-front: found 'up'"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(capsys, tmp_path, arguments, words):
    folders = {name: tmp_path / name for name in ("empty", "broken", "nopicture", "grid")}
    for folder in folders.values():
        folder.mkdir()
    (folders["broken"] / "groundtruth.json").write_text("{")
    gone = {"image_size": [64, 48], "frames": {"gone.png": {}}, "pairs": [{"a": "gone.png", "b": "gone.png"}]}
    (folders["nopicture"] / "groundtruth.json").write_text(json.dumps(gone))
    (folders["grid"] / "0_0_FRONT_LEFT.png").touch()
    (tmp_path / "file").touch()
    (tmp_path / "other.json").write_text(json.dumps([{"name": "else"}]))
    places = folders | {
        "missing": tmp_path / "missing", "office": OFFICE, "bricks": BRICKS, "file": tmp_path / "file", "other": tmp_path / "other.json",
    }  # fmt: skip
    # The quick method, unless the case names one: what is refused does not depend on it.
    quick = [] if "--method" in arguments else ["--method", "straight"]
    code, out, err = run(capsys, *(text.format(**places) for text in arguments), *quick)
    assert (code, out) == (2, "")
    assert err.startswith("detector: error: ")
    assert err.count("\n") == 1
    assert words in err


def test_shares_are_checked_by_the_command_line(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["evaluate", str(OFFICE), "--min-valid-frac", "2"])
    assert caught.value.code == 2
    assert "allowed is a share from 0 to 1" in capsys.readouterr().err


def test_off_a_terminal_nothing_is_written_to_stderr():
    done = subprocess.run(
        [sys.executable, "-m", "detector.cli", "evaluate", str(BRICKS), "--method", "straight"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stderr == ""
