"""``companion tune`` as people use it."""

from __future__ import annotations

import json
import shutil
import signal
import tomllib
from pathlib import Path

import cv2
import pytest

pytest.importorskip("optuna")

from companion.cli import main
from companion.config_sources import ConfigPlaces, load
from companion.sim.suite import Ending
from companion.tune.command import _ended_like_ctrl_c
from companion.tune.errors import TrialError
from companion.tune.flights import Flights, tables_with
from companion.tune.pairs import TruePairs, load_pairs
from companion.vision.child import build_pipeline

PAIRS = Path(__file__).parents[2] / "data" / "pairs"
WALL = PAIRS / "brickwall"


def tune(*arguments):
    return main(["tune", *(str(each) for each in arguments)])


def test_a_search_on_pairs_leaves_a_configuration_that_the_service_takes(tmp_path, capsys):
    out = tmp_path / "out"
    search = ("--search", "round_trip_px=0.5..1.5", "--search", "grey_sigma", "--search", "plane_share")
    assert tune(WALL, "--trials", 2, "--seed", 3, "-o", out, "--json", *search) == 0
    said = capsys.readouterr()
    report = json.loads(said.out, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert report == json.loads((out / "report.json").read_text())
    assert (report["searched"]["cases"], report["held_out"]["cases"]) == (2, 1)
    assert report["trials"] == 2
    assert set(report["settings"]) == {"round_trip_px", "grey_sigma", "plane_share"}
    assert report["warning"] is not None
    assert report["warning"] in said.err
    for name in ("history.png", "settings.png"):
        assert cv2.imread(str(out / name)).std() > 1.0
    params = tomllib.loads((out / "params.toml").read_text())
    assert params == report["settings"]
    config = load(ConfigPlaces(out / "companion.toml", {}, ())).config
    assert config.detector.method == "parallax"
    assert build_pipeline(config.detector, config.camera)._parallax_params.grey_sigma == params["grey_sigma"]


def test_an_interruption_is_not_the_end(tmp_path, capsys, monkeypatch):
    judged = []
    whole = TruePairs.scores

    def interrupted(self, settings, part, on_case=lambda: None):
        judged.append(part)
        if len(judged) == 2:
            raise KeyboardInterrupt
        return whole(self, settings, part, on_case)

    monkeypatch.setattr(TruePairs, "scores", interrupted)
    command = (WALL, "-o", tmp_path, "--search", "round_trip_px", "--limit", 2)
    assert tune(*command, "--trials", 9) == 130
    assert "1 finished trials are kept" in capsys.readouterr().err
    assert tune(*command, "--trials", 1) == 0
    assert judged == ["searched", "searched", "held_out"]  # what was finished is not judged again
    assert (tmp_path / "companion.toml").is_file()


def test_both_polite_requests_to_end_are_taken():
    for number in (signal.SIGINT, signal.SIGTERM):
        before = signal.getsignal(number)
        with pytest.raises(KeyboardInterrupt), _ended_like_ctrl_c():
            signal.raise_signal(number)
        assert signal.getsignal(number) is before


def test_the_last_pairs_are_held_out_and_share_no_frame_with_the_others(tmp_path):
    truth = {
        "image_size": [8, 8],
        "K": None,
        "frames": {f"{i}.png": {"single_plane": True} for i in range(11)},
        "pairs": [{"a": f"{i}.png", "b": f"{i + 1}.png"} for i in range(10)],
    }
    (tmp_path / "groundtruth.json").write_text(json.dumps({"name": "walk", **truth}))
    found = load_pairs(tmp_path, min_baseline_m=None, truth=None, limit=None, hold_out=0.3)
    assert [pair.a for pair in found.held_out] == ["7.png", "8.png", "9.png"]
    assert [pair.a for pair in found.searched] == [f"{i}.png" for i in range(6)]  # 6 -> 7 would show frame 7
    whole = load_pairs(tmp_path, min_baseline_m=None, truth=None, limit=None, hold_out=0.0)
    assert (len(whole.searched), len(whole.held_out)) == (10, 0)


class Flown:
    """Flies nowhere: the nearer to a wall the steps may end, the sooner at the goal, until it is hit."""

    def __init__(self):
        self.tables = []

    def __call__(self, flights):
        for flight in reversed(flights):  # they come in any order
            settings = flight.spec.settings
            self.tables.append(settings)
            margin_m = settings["guidance"]["step_margin_m"]
            params = tomllib.loads(Path(settings["detector"]["params_file"]).read_text())
            assert set(params) == {"round_trip_px"}
            outcome = "collided" if margin_m < 0.3 else "reached"
            yield flight, Ending(result={"outcome": outcome, "time_s": 20.0 + 10.0 * margin_m})


def flights(fly, seeds=(1, 2, 3, 4)):
    from companion.sim.flight import FlightSpec

    return Flights(["door"], seeds, FlightSpec(), hold_out=0.25, fly_all=lambda: fly)


def test_flights_are_flown_with_the_settings_and_a_collision_counts_first():
    fly = Flown()
    cases = flights(fly)
    assert (cases.count("searched"), cases.count("held_out")) == (3, 1)
    near, far = (
        cases.scores({"guidance.step_margin_m": margin_m, "round_trip_px": 0.7}, "searched").mean()
        for margin_m in (0.4, 0.8)
    )
    hit = cases.scores({"guidance.step_margin_m": 0.1, "round_trip_px": 0.7}, "searched").mean()
    assert near > far > 0.5 > hit
    assert len(fly.tables) == 9
    assert not Path(fly.tables[0]["detector"]["params_file"]).exists()


def test_what_all_flights_have_goes_with_what_is_tried(tmp_path):
    from companion.sim.flight import FlightSpec

    template = FlightSpec(method="paper", settings={"detector": {"preset": "paper"}})
    tried = {"guidance.max_step_m": 0.4, "min_features": 70}
    assert tables_with(tried, tmp_path, template) == {
        "detector": {"method": "paper", "preset": "paper", "params_file": str(tmp_path / "params.toml")},
        "guidance": {"max_step_m": 0.4},
    }
    assert (tmp_path / "params.toml").read_text() == "min_features = 70\n"


def test_a_flight_that_cannot_be_simulated_is_a_trial_without_a_value():
    def broken(planned):
        yield planned[0], Ending(error="no memory")

    with pytest.raises(TrialError, match="door-s1-parallax: no memory"):
        flights(broken).scores({}, "searched")


def test_settings_that_the_configuration_refuses_are_not_flown():
    def never(planned):
        pytest.fail("flown")

    with pytest.raises(TrialError, match="max_step_m"):
        flights(never).scores({"guidance.max_step_m": -1.0}, "searched")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "needed are folders of pairs, or --world"),
        (("{wall}", "--world", "door"), "one of the two"),
        (("no/such/folder",), "no/such/folder: is not a folder"),
        (("{recording}",), "a recording does not say where the free way was"),
        (("{recordings}",), "recordings have no truth"),
        (("{unknown}",), "nothing is known of what its 3 pairs show"),
        (("{broken}",), "groundtruth.json"),
        (("{wall}", "--search", "nonsense"), "nonsense: no such setting"),
        (("{wall}", "--search", "guidance.max_step_m"), "no such setting"),
        (("{wall}", "--min-baseline", "0.2"), "pose"),
        (("{wall}", "-o", "{wall}/groundtruth.json"), "cannot be used"),
        (("--world", "nowhere"), "nowhere"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path, capsys, arguments, words):
    for name in ("recordings", "unknown", "broken"):
        (tmp_path / name).mkdir()
    recording = tmp_path / "recordings" / "flight.mcap"
    recording.write_bytes(b"x")
    truth = json.loads((WALL / "groundtruth.json").read_text())
    truth["frames"] = {name: {} for name in truth["frames"]}
    truth["pairs"] = [{"a": pair["a"], "b": pair["b"]} for pair in truth["pairs"]]
    (tmp_path / "unknown" / "groundtruth.json").write_text(json.dumps(truth))
    (tmp_path / "broken" / "groundtruth.json").write_text("{")
    places = {name: tmp_path / name for name in ("recordings", "unknown", "broken")}
    named = [each.format(wall=WALL, recording=recording, **places) for each in arguments]
    assert tune(*(named if "-o" in named else [*named, "-o", tmp_path / "out"]), "--trials", 1) == 1
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_a_missing_image_is_one_clear_line(tmp_path, capsys):
    shutil.copy(WALL / "groundtruth.json", tmp_path)
    assert tune(tmp_path, "-o", tmp_path / "out", "--trials", 1) == 1
    assert "cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [["--trials", "0"], ["--hold-out", "1"], ["--spread", "1"], ["--seeds", "3..1"], ["--min-baseline", "x"]],
)
def test_values_that_are_not_allowed_are_usage_errors(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        tune(WALL, *arguments)
    assert stop.value.code == 2
    assert "found" in capsys.readouterr().err
