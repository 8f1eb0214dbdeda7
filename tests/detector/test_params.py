from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from detector.params import DetectorParams, ParamsError, scaled_px


def test_the_paper_preset_holds_the_papers_numbers() -> None:
    params = DetectorParams.preset("paper")
    assert params == DetectorParams()
    assert params.min_features == 100
    assert params.round_trip_px == 0.5
    assert params.shortest_fraction == 0.1
    assert params.angle_statistics == "linear"
    assert (params.clusters_min, params.clusters_max) == (2, 15)
    assert params.nearest_step * params.nearest_steps == 40
    assert params.nearest_change == 0.05
    assert params.plane_test == "deviation_px"
    assert params.plane_deviation_px_at_1280 == pytest.approx(500 / 57.2958, abs=0.005)
    assert (params.line_angle_min_deg, params.line_angle_max_deg) == (40.0, 140.0)
    assert (params.pair_angle_min_deg, params.pair_angle_max_deg) == (5.0, 15.0)
    assert params.cell_px == 10.0
    assert params.vote_tolerance == 0.05
    assert params.lines_wanted == 0
    assert not params.unique_locations


def test_the_default_preset_is_another_one() -> None:
    params = DetectorParams.preset("default")
    assert params.plane_test != "deviation_px"  # free of scale
    assert params.rotation_check
    assert params.lk_predict_rotation


def test_overrides_replace_single_fields() -> None:
    params = DetectorParams.preset("default", seed=7)
    assert params.seed == 7
    assert params.model_copy(update={"seed": 0}) == DetectorParams.preset("default")


def test_parameters_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        DetectorParams().seed = 3  # type: ignore[misc]


def test_every_field_is_described() -> None:
    for name, field in DetectorParams.model_fields.items():
        assert field.description, name


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ParamsError, match=r"preset: found 'papre', allowed are default, paper"):
        DetectorParams.preset("papre")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sede = 1", r"sede: unknown key \(found 1\); allowed are .*seed"),
        ("seed = -1", r"seed: found -1, allowed: input should be greater than or equal to 0"),
        ("seed = 1.5", r"seed: found 1.5, allowed: input should be a valid integer"),
        ('seed = "1"', r"seed: found '1', allowed: input should be a valid integer"),
        ("seed = true", r"seed: found True, allowed: input should be a valid integer"),
        ("round_trip_px = nan", r"round_trip_px: found nan"),
        ("edge_high = inf", r"edge_high: found inf"),
        ('plane_test = "both"', r"plane_test: found 'both', allowed: .*deviation_px"),
        ("lk_window_px = 14", r"lk_window_px must be odd, found 14"),
        ("clusters_min = 16", r"clusters_min \(16\) must not exceed clusters_max \(15\)"),
        ("edge_low = 2.0", r"edge_low \(2.0\) must not exceed edge_high"),
        ("line_angle_min_deg = 150", r"line_angle_min_deg \(150(\.0)?\) must not exceed"),
        ("pair_angle_min_deg = 16", r"pair_angle_min_deg \(16(\.0)?\) must not exceed"),
        ("seed = ", r"is not valid TOML"),
    ],
)
def test_a_file_that_cannot_be_used_is_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "my.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ParamsError, match=rf"my\.toml.*{message}"):
        DetectorParams.from_toml(path)


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text("seed = -1\nsede = 1\ncell_px = 0", encoding="utf-8")
    with pytest.raises(ParamsError) as caught:
        DetectorParams.from_toml(path)
    assert len(str(caught.value).splitlines()) == 3


def test_a_file_that_cannot_be_read_is_explained(tmp_path: Path) -> None:
    with pytest.raises(ParamsError, match=r"absent\.toml: cannot be read: No such file"):
        DetectorParams.from_toml(tmp_path / "absent.toml")
    with pytest.raises(ParamsError, match="cannot be read"):
        DetectorParams.from_toml(tmp_path)
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b"# caf\xe9\nseed = 1")
    with pytest.raises(ParamsError, match="is not UTF-8"):
        DetectorParams.from_toml(latin)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_a_file_overrides_the_preset_it_is_read_over(tmp_path: Path, preset: str) -> None:
    path = tmp_path / "my.toml"
    path.write_text("seed = 9\nround_trip_px = 1  # a whole number will do\n", encoding="utf-8")
    params = DetectorParams.from_toml(path, preset)  # type: ignore[arg-type]
    assert params == DetectorParams.preset(preset, seed=9, round_trip_px=1.0)  # type: ignore[arg-type]


@given(value=st.floats(0.0, 1000.0), width_px=st.integers(64, 4096))
def test_figures_for_1280_scale_with_the_width(value: float, width_px: int) -> None:
    assert scaled_px(value, 1280) == pytest.approx(value)
    assert scaled_px(value, 2 * width_px) == pytest.approx(2.0 * scaled_px(value, width_px))
