"""The command line of ``companion sim``: a result whatever becomes of a flight, one clear line where there is none."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from companion.cli import main
from companion.sim.flight_record import FlightRecord

BOX = """
name = "box"
time_limit_s = {limit_s}
start = {{ north_m = 2, east_m = 2 }}
goal = {{ north_m = {goal_north_m}, east_m = 2 }}
walls = [
    {{ from_m = [0, 0], to_m = [8, 0] }},
    {{ from_m = [8, 0], to_m = [8, 4] }},
    {{ from_m = [8, 4], to_m = [0, 4] }},
    {{ from_m = [0, 4], to_m = [0, 0] }},
    {{ from_m = [5, 0], to_m = [5, {wall_m}] }},
]
"""


def box(folder: Path, *, goal_north_m: float = 4.0, wall_m: float = 0.5, limit_s: float = 60.0) -> str:
    path = folder / "box.toml"
    path.write_text(BOX.format(goal_north_m=goal_north_m, wall_m=wall_m, limit_s=limit_s))
    return str(path)


def test_a_flight_prints_one_json_object_with_the_promised_keys_and_keeps_its_record(tmp_path, capsys):
    record = tmp_path / "flight.npz"
    words = ["sim", "--world", box(tmp_path), "--seed", "3", "--method", "off", "--json"]
    assert main([*words, "--record", str(record)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["outcome"] == "reached"
    assert {
        "world", "seed", "method", "outcome", "time_s", "path_m", "min_clearance_m", "collisions", "decisions",
        "free_ratio_median", "states", "max_setpoint_gap_s",
    } <= result.keys()  # fmt: skip
    assert (result["world"], result["seed"], result["method"]) == ("box", 3, "off")
    kept = FlightRecord.load(record)
    assert kept.about["result"]["path_m"] == result["path_m"]
    assert kept.duration_s == pytest.approx(result["time_s"], abs=0.01)


def test_a_video_is_written_where_it_is_asked_for(tmp_path, capsys):
    video = tmp_path / "flight.mp4"
    assert main(["sim", "--world", box(tmp_path), "--method", "off", "--video", str(video)]) == 0
    assert "reached" in capsys.readouterr().out
    frames = cv2.VideoCapture(str(video))
    assert frames.read()[0]
    frames.release()


def test_the_exit_code_is_0_also_for_a_collision(tmp_path, capsys):
    world = box(tmp_path, goal_north_m=6.5, wall_m=3.0)
    assert main(["sim", "--world", world, "--method", "off"]) == 0
    assert "collided" in capsys.readouterr().out


def test_the_world_has_the_time_limit_unless_it_is_said(tmp_path, capsys):
    world = box(tmp_path, limit_s=5.0)
    for words, limit_s in ((["--time-limit", "1"], 1.0), ([], 5.0)):
        assert main(["sim", "--world", world, "--method", "off", "--json", *words]) == 0
        result = json.loads(capsys.readouterr().out)
        assert result["time_s"] <= limit_s


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--world", "coridor"], "did you mean corridor?"),
        (["--world", "absent.toml"], "absent.toml"),
        (["--world", "corridor", "--planner", "mavsdk"], "real time"),
        (["--world", "corridor", "--hfov", "170"], "hfov_deg"),
        (["--world", "corridor", "--drift", "-1"], "position_drift"),
        (["--world", "corridor", "--rate", "nan"], "frame_rate_hz"),
        (["--world", "corridor", "--size", "9x9"], "width_px"),
    ],
)
def test_what_cannot_be_flown_is_one_line_that_names_it(words, named, capsys):
    assert main(["sim", *words]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert named in error


@pytest.mark.parametrize(
    "words", [[], ["--world", "corridor", "--size", "big"], ["--world", "corridor", "--method", "magic"]]
)
def test_a_wrong_command_line_is_exit_code_2(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["sim", *words])
    assert ended.value.code == 2
    assert "companion sim: error:" in capsys.readouterr().err


def test_help_names_the_command_among_the_others(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "sim" in capsys.readouterr().out
