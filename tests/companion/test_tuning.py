"""Settings by their names on the wire."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from companion.config import CameraConfig, Config
from companion.errors import ConfigError
from companion.tuning import LONGEST_NAME, SETTINGS, changed, choices, from_float32, number_of, value_of

BY_NAME = {setting.name: setting for setting in SETTINGS}


def as_float32(number: float) -> float:
    return struct.unpack("<f", struct.pack("<f", number))[0]


def test_names_fit_are_ascii_unique_and_in_order():
    names = [setting.name for setting in SETTINGS]
    assert names == sorted(set(names))
    assert all(name.isascii() and 0 < len(name) <= LONGEST_NAME for name in names)


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_every_default_survives_the_wire(setting):
    config = Config()
    assert changed(config, setting, as_float32(number_of(config, setting))) == config


@pytest.mark.parametrize("decimal", [0.8, 1.5, 0.1, 1e-7, 123.456, 30.0, -77.7, 0.0, 3600.0])
def test_a_decimal_comes_back_as_it_was_written(decimal):
    assert from_float32(as_float32(decimal)) == decimal


def test_choices_and_switches_are_numbers():
    config = changed(Config(), BY_NAME["VOID_VELOCITY"], 2.0)
    assert config.guidance.velocity == "forward"
    assert number_of(config, BY_NAME["VOID_VELOCITY"]) == 2.0
    assert choices(BY_NAME["VOID_GIVE_UP"]) == ("stay", "autopilot_hold")
    assert value_of(changed(config, BY_NAME["VOID_BOOT_PROBE"], 0.0), BY_NAME["VOID_BOOT_PROBE"]) is False
    assert type(value_of(changed(config, BY_NAME["VOID_WALL_N"], 5.0), BY_NAME["VOID_WALL_N"])) is int


@pytest.mark.parametrize(
    ("name", "number", "why"),
    [
        ("VOID_MAX_STEP_M", 99.0, "guidance.max_step_m: found 99.0; allowed: number above 0 and up to 20"),
        ("VOID_MAX_STEP_M", float("nan"), "not a finite number"),
        ("VOID_MAX_STEP_M", float("-inf"), "not a finite number"),
        ("VOID_WALL_N", 2.5, "found 2.5; allowed: a whole number"),
        ("VOID_WALL_K", 9.0, "guidance.wall_k: found 9; allowed: at most wall_n, which is 3"),
        ("VOID_BOOT_PROBE", 2.0, "found 2; allowed: 0 or 1"),
        ("VOID_VELOCITY", 3.0, "found 3; allowed: 0 redirect, 1 hold, 2 forward"),
        ("VOID_TURN_DEG", 60.0, "at most half of camera.hfov_deg"),
    ],
)
def test_what_the_file_would_not_take_is_refused_in_one_line(name, number, why):
    with pytest.raises(ConfigError) as refused:
        changed(Config(), BY_NAME[name], number)
    assert why in str(refused.value)
    assert str(refused.value).startswith(f"{name}: ")
    assert "\n" not in str(refused.value)


def test_what_was_left_out_of_the_file_stays_so():
    given = changed(Config(camera=CameraConfig(hfov_deg=80.0)), BY_NAME["VOID_MAX_STEP_M"], 1.0)
    assert "hfov_deg" in given.camera.model_fields_set
    assert "hfov_deg" not in changed(Config(), BY_NAME["VOID_MAX_STEP_M"], 1.0).camera.model_fields_set


def test_the_documentation_names_each_with_its_default():
    page = (Path(__file__).parents[2] / "docs" / "ground-station.md").read_text()
    for setting in SETTINGS:
        assert f"| `{setting.name}` | `{setting.key}` | {number_of(Config(), setting):g} |" in page
