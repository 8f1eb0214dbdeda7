"""The search: shared, gone on with, interrupted, and what is said of its gain."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("optuna")

from companion.tune import outcome, pictures, study
from companion.tune.errors import TuneError
from companion.tune.files import config_files

sys.path.insert(0, str(Path(__file__).parent))
from toy import BEST_ROUND_TRIP_PX, SPACE, USUAL, Toy

sys.path.pop(0)
SCRIPT = Path(__file__).with_name("toy.py")
WAIT_S = 500.0
"""Generous: each commit of a database waits for the disk, and a gate may share its machine."""


def begin(path, about=None, space=SPACE, name="toy"):
    return study.open_study(study.open_storage(str(path)), name, space, about or Toy().about(), 7)


def ended(begun, cases):
    best, trials = begun.best_trial, study.finished(begun)
    return outcome.judged(
        cases,
        study.settings_of(best, SPACE),
        USUAL,
        searched=outcome.gain_of(study.scores_of(trials[0]), study.scores_of(best)),
        trials=len(trials),
        best_trial=best.number,
        importances={"round_trip_px": 0.9, "cauchy_px": 0.0, "plane_share": 0.1},
    )


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    begun = begin(tmp_path_factory.mktemp("tune") / "study.journal")
    study.search(begun, SPACE, Toy(), 30)
    return begun


def test_the_usual_settings_come_first_and_the_best_are_found(searched):
    trials = study.finished(searched)
    assert len(trials) == 30
    assert study.settings_of(trials[0], SPACE) == USUAL
    best = study.settings_of(searched.best_trial, SPACE)
    assert best["round_trip_px"] == pytest.approx(BEST_ROUND_TRIP_PX, rel=0.15)
    assert np.mean(study.scores_of(searched.best_trial)) == pytest.approx(searched.best_value)


def test_what_matters_is_told_from_what_does_not(searched):
    shares = study.importances(searched)
    assert next(iter(shares)) == "round_trip_px"
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["round_trip_px"] > 0.8


@pytest.mark.parametrize(
    ("held_out_gain", "verdict", "word"),
    [(1.0, "holds", None), (-1.0, "lost", "does not survive"), (0.0, "lost", "does not survive")],
)
def test_a_gain_that_does_not_survive_is_warned_of(searched, held_out_gain, verdict, word):
    found = ended(searched, Toy(held_out_gain))
    assert found.searched.difference > 0.0
    assert found.verdict == verdict
    warning = outcome.warning_of(found)
    assert (warning is None) == (word is None)
    if word is not None:
        assert word in warning
        assert "NOTE" in config_files(found, "parallax", "default")["companion.toml"]


def test_a_gain_on_a_few_of_many_cases_is_not_shown():
    usual, best = np.zeros(20), np.zeros(20)
    best[3] = 1.0
    gain = outcome.gain_of(usual, best)
    assert gain.difference == pytest.approx(0.05)
    assert gain.interval[0] == 0.0
    found = outcome.Outcome(5, 1, {"round_trip_px": 1.0}, {"round_trip_px": 0.7}, gain, gain, {})
    assert found.verdict == "not shown"
    assert "may be chance" in outcome.markdown(found, ())
    assert outcome.Outcome(5, 1, {"a": 1}, {"a": 2}, gain, None, {}).verdict == "unknown"


def test_pictures_show_every_setting(searched):
    trials = study.finished(searched)
    for picture in (
        pictures.history(trials),
        pictures.settings(trials, SPACE),
        pictures.importance({"round_trip_px": 0.9, "cauchy_px": 0.0}),
    ):
        assert picture.dtype == np.uint8
        assert picture.std() > 1.0


def test_a_search_is_gone_on_with_and_not_begun_anew(tmp_path):
    file = tmp_path / "study.journal"
    study.search(begin(file), SPACE, Toy(), 4)
    again = begin(file)
    counting = Toy()
    study.search(again, SPACE, counting, 7)
    assert counting.judged == 3
    study.search(again, SPACE, counting, 5)  # it has them already
    assert counting.judged == 3
    settings = [tuple(study.settings_of(trial, SPACE).values()) for trial in study.finished(again)]
    assert len(set(settings)) == 7  # the same seed does not suggest the same again


def test_another_search_of_the_same_name_is_refused(tmp_path):
    begin(tmp_path / "study.journal")
    with pytest.raises(TuneError, match="of other settings or cases"):
        begin(tmp_path / "study.journal", about={"toy": False})
    with pytest.raises(TuneError, match="of other settings or cases"):
        begin(tmp_path / "study.journal", space=SPACE[:2])
    begin(tmp_path / "study.journal", about={"toy": False}, name="other")


def test_what_was_finished_before_an_interruption_is_kept(tmp_path):
    begun = begin(tmp_path / "study.journal")
    with pytest.raises(KeyboardInterrupt):
        study.search(begun, SPACE, Toy(interrupt_at=4), 30)
    again = begin(tmp_path / "study.journal")
    assert len(study.finished(again)) == 3
    study.search(again, SPACE, Toy(), 5)
    assert len(study.finished(again)) == 5


def test_settings_that_cannot_be_judged_do_not_end_the_search(tmp_path):
    begun = begin(tmp_path / "study.journal")
    reasons = []
    study.search(
        begun,
        SPACE,
        Toy(refuse_above=0.9),
        6,
        on_trial=lambda trial: reasons.append(trial.user_attrs.get("reason")),
    )
    assert len(study.finished(begun)) == 6
    assert all(study.settings_of(trial, SPACE)["plane_share"] <= 0.9 for trial in study.finished(begun))
    assert reasons.count(None) == 6


def test_usual_settings_that_cannot_be_judged_end_it(tmp_path):
    with pytest.raises(TuneError, match="the usual settings cannot be judged: plane_share: too much"):
        study.search(begin(tmp_path / "study.journal"), SPACE, Toy(refuse_above=0.1), 6)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("storage", ["study.journal", "sqlite:///{}/study.db"])
def test_two_processes_share_a_search(tmp_path, storage):
    where = storage.format(tmp_path) if "://" in storage else str(tmp_path / storage)
    study.open_study(study.open_storage(where), "shared", SPACE, Toy().about(), None)
    begun = [
        subprocess.Popen([sys.executable, SCRIPT, where, "6"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for _ in range(2)
    ]
    try:
        said = [process.communicate(timeout=WAIT_S) for process in begun]
    finally:
        for process in begun:
            process.kill()
            process.communicate()
    assert [process.returncode for process in begun] == [0, 0], said
    trials = study.finished(study.open_study(study.open_storage(where), "shared", SPACE, Toy().about(), None))
    own = [int(out) for out, _ in said]
    assert sum(own) == len(trials)  # each trial was made by one of them
    assert 6 <= len(trials) <= 7  # both may be at the last one
    assert len({trial.number for trial in trials}) == len(trials)
    assert sum(study.settings_of(trial, SPACE) == USUAL for trial in trials) == 1


@pytest.mark.parametrize(
    "where",
    ["nonsense://x", "sqlite:////no/such/folder/study.db", "/no/such/folder/study.journal", "notes.txt"],
)
def test_a_storage_that_cannot_be_used_is_one_clear_line(tmp_path, monkeypatch, where):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("milk\nbread\n")
    with pytest.raises(TuneError, match="--storage") as raised:
        begin(where)
    assert "\n" not in str(raised.value)
    assert (tmp_path / "notes.txt").read_text() == "milk\nbread\n"
