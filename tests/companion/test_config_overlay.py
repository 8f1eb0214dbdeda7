"""What a ground station has set: written as a whole, read after the configuration."""

from __future__ import annotations

import os
import tomllib

import pytest

from companion.config_overlay import write_overlay
from companion.config_sources import load_config
from companion.errors import ConfigError


def test_what_is_written_is_read_after_the_configuration_and_wins(tmp_path):
    (tmp_path / "drone.toml").write_text("[guidance]\nmax_step_m = 2.0\nagree_deg = 15.0\n")
    before = load_config(tmp_path / "drone.toml")
    tuned = tmp_path / "drone.tuned.toml"
    assert before.ground_station.parameters_file == str(tuned)
    write_overlay(tuned, {"guidance.max_step_m": 1.0, "guidance.velocity": "hold"})
    write_overlay(
        tuned, {"guidance.max_step_m": 0.8, "guidance.bootstrap_probe": False, "engagement.by": "rc"}
    )
    after = load_config(tmp_path / "drone.toml")
    assert (after.guidance.max_step_m, after.guidance.agree_deg) == (0.8, 15.0)
    assert (after.guidance.velocity, after.guidance.bootstrap_probe) == ("hold", False)
    assert after.engagement.by == "rc"
    assert after.guidance == before.guidance.model_copy(
        update={"max_step_m": 0.8, "velocity": "hold", "bootstrap_probe": False}
    )


def test_the_file_can_be_named(tmp_path):
    (tmp_path / "drone.toml").write_text('[ground_station]\nparameters_file = "set.toml"\n')
    write_overlay(tmp_path / "set.toml", {"guidance.max_step_m": 0.5})
    assert load_config(tmp_path / "drone.toml").guidance.max_step_m == 0.5


def test_a_fault_in_it_names_it(tmp_path):
    (tmp_path / "drone.toml").write_text("")
    (tmp_path / "drone.tuned.toml").write_text("[guidance]\nmax_step_m = -1.0\n")
    with pytest.raises(ConfigError, match=r"drone\.tuned\.toml: guidance\.max_step_m: found -1\.0"):
        load_config(tmp_path / "drone.toml")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    tuned = tmp_path / "x.tuned.toml"
    write_overlay(tuned, {"guidance.max_step_m": 0.5})
    old = tuned.read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigError, match="cannot be written: No space left on device"):
        write_overlay(tuned, {"guidance.max_step_m": 0.9})
    assert tuned.read_bytes() == old
    assert [path.name for path in tmp_path.iterdir()] == ["x.tuned.toml"]


def test_a_missing_folder_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match="cannot be written: No such file or directory"):
        write_overlay(tmp_path / "gone" / "x.toml", {"guidance.max_step_m": 0.9})


def test_a_damaged_file_is_not_overwritten(tmp_path):
    tuned = tmp_path / "x.toml"
    tuned.write_text("[guidance\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        write_overlay(tuned, {"guidance.max_step_m": 0.9})
    assert tuned.read_text() == "[guidance\n"


def test_it_may_be_read_by_people(tmp_path):
    write_overlay(tmp_path / "x.toml", {"guidance.max_step_m": 0.9})
    assert (tmp_path / "x.toml").stat().st_mode & 0o777 == 0o644
    assert tomllib.loads((tmp_path / "x.toml").read_text()) == {"guidance": {"max_step_m": 0.9}}


def test_under_systemd_it_is_where_the_service_may_write(tmp_path, monkeypatch):
    (tmp_path / "etc").mkdir()
    (tmp_path / "state").mkdir()
    (tmp_path / "etc" / "config.toml").write_text("")
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/state:{tmp_path}/other")
    write_overlay(tmp_path / "state" / "config.tuned.toml", {"guidance.max_step_m": 0.5})
    config = load_config(tmp_path / "etc" / "config.toml")
    assert config.guidance.max_step_m == 0.5
    assert config.ground_station.parameters_file == str(tmp_path / "state" / "config.tuned.toml")
