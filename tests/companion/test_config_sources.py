"""Where values come from: the order of the places, and that each fault and each value names its own."""

from __future__ import annotations

import tomllib

import pytest

from companion.cli import main
from companion.config import Config
from companion.config_file import parse_config
from companion.config_sources import ConfigPlaces, load, shown_with_origins
from companion.errors import ConfigError
from companion.reload import signature_of

KEY = "guidance.max_step_m"


def write(path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def places(tmp_path, *, levels: int) -> ConfigPlaces:
    """The first so many of the places, each with another value of one key."""
    main_file = tmp_path / "config.toml"
    write(main_file, "[guidance]\nmax_step_m = 1.0\nagree_deg = 15.0\n")
    if levels > 1:
        write(tmp_path / "config.d" / "10-room.toml", "[guidance]\nmax_step_m = 2.0\n")
    if levels > 2:
        write(tmp_path / "config.d" / "20-later.toml", "[guidance]\nmax_step_m = 3.0\n")
    if levels > 3:
        write(tmp_path / "config.tuned.toml", "[guidance]\nmax_step_m = 4.0\n")
    environment = {"VOID_COMPANION_GUIDANCE__MAX_STEP_M": "5.0", "HOME": "/"} if levels > 4 else {}
    options = (f"{KEY}=6.0", f"{KEY}=7.0") if levels > 5 else ()
    return ConfigPlaces(main_file, environment, options)


@pytest.mark.parametrize(
    ("levels", "value", "origin"),
    [
        (1, 1.0, "config.toml"),
        (2, 2.0, "10-room.toml"),
        (3, 3.0, "20-later.toml"),
        (4, 4.0, "config.tuned.toml"),
        (5, 5.0, "environment VOID_COMPANION_GUIDANCE__MAX_STEP_M"),
        (6, 7.0, "-o guidance.max_step_m"),
    ],
)
def test_the_later_place_wins_and_is_named(tmp_path, levels, value, origin):
    loaded = load(places(tmp_path, levels=levels))
    assert loaded.config.guidance.max_step_m == value
    assert loaded.origin(KEY).endswith(origin)
    assert loaded.config.guidance.agree_deg == 15.0
    assert loaded.origin("guidance.agree_deg").endswith("config.toml")
    assert loaded.origin("guidance.align_deg") == "default"


def test_what_the_page_saved_under_systemd_is_read_between_the_files_and_the_ground_station(
    tmp_path, monkeypatch, capsys
):
    state = tmp_path / "state"
    write(state / "config.page.toml", "[guidance]\nmax_step_m = 3.5\nagree_deg = 16.0\n")
    three = places(tmp_path, levels=3)
    assert (
        load(three).config.guidance.max_step_m == 3.0
    )  # without a state directory the main file is saved to
    assert load(three).config.web.saved_file == ""
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    loaded = load(three)
    page = str(state / "config.page.toml")
    assert (loaded.config.guidance.max_step_m, loaded.origin(KEY)) == (3.5, page)
    assert loaded.config.web.saved_file == page
    assert main(["config", "--show", "-c", str(three.file)]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("agree_deg = ")]
    assert line.endswith(f"# {page}")
    write(state / "config.tuned.toml", "[guidance]\nmax_step_m = 4.0\n")
    assert load(three).config.guidance.max_step_m == 4.0
    assert load(places(tmp_path, levels=5)).config.guidance.max_step_m == 5.0
    write(state / "config.page.toml", "[guidance]\nmax_step_m = -1.0\nagree_deg = true\n")
    with pytest.raises(ConfigError, match=r"config\.page\.toml: guidance\.agree_deg"):
        load(three)


def test_a_page_file_that_is_named_is_read_and_saved_to(tmp_path):
    main_file = tmp_path / "config.toml"
    write(main_file, '[guidance]\nmax_step_m = 1.0\n[web]\nsaved_file = "saved/mine.toml"\n')
    assert load(ConfigPlaces(main_file)).config.web.saved_file == str(tmp_path / "saved" / "mine.toml")
    write(tmp_path / "saved" / "mine.toml", "[guidance]\nmax_step_m = 2.5\n")
    assert load(ConfigPlaces(main_file)).config.guidance.max_step_m == 2.5


def test_a_file_that_the_page_has_saved_is_noticed(tmp_path):
    one, saved = places(tmp_path, levels=1), tmp_path / "page.toml"
    before = signature_of(one, "", str(saved))
    write(saved, "[guidance]\nmax_step_m = 2.5\n")
    assert signature_of(one, "", str(saved)) != before


def test_a_setting_that_is_not_in_its_file_yet_counts_as_if_it_were(tmp_path):
    few = places(tmp_path, levels=4)
    assert load(few, unsaved={KEY: 4.5}).config.guidance.max_step_m == 4.5
    over = places(tmp_path, levels=5)
    assert load(over, unsaved={KEY: 4.5}).config.guidance.max_step_m == 5.0


def test_without_a_file_environment_and_command_line_hold():
    loaded = load(ConfigPlaces(None, {"VOID_COMPANION_LOG__LEVEL": "debug"}, ("log.detections=true",)))
    assert (loaded.config.log.level, loaded.config.log.detections) == ("debug", True)
    assert load(ConfigPlaces()).config == Config()


@pytest.mark.parametrize(
    ("environment", "options", "line"),
    [
        ({}, (f"{KEY}=fast",), '-o guidance.max_step_m: guidance.max_step_m: found "fast"; allowed: number'),
        ({}, (KEY,), "-o guidance.max_step_m: allowed: TABLE.KEY=VALUE"),
        ({}, ("max_step_m=1",), "-o max_step_m=1: allowed: TABLE.KEY=VALUE"),
        ({}, ("guidance.max_step=1",), "did you mean guidance.max_step_m?"),
        ({}, (f"{KEY}=1\nx=2",), "-o guidance.max_step_m: guidance.max_step_m: found"),
        ({"VOID_COMPANION_GUIDANCE": "1"}, (), "allowed: VOID_COMPANION_TABLE__KEY"),
        (
            {"VOID_COMPANION_GUIDANCE__WALL_K": "2.5"},
            (),
            "environment VOID_COMPANION_GUIDANCE__WALL_K: guidance.wall_k: found 2.5; allowed: whole number",
        ),
    ],
)
def test_a_fault_names_the_place_and_the_key(environment, options, line):
    with pytest.raises(ConfigError) as caught:
        load(ConfigPlaces(None, environment, options))
    assert line in str(caught.value)


def test_faults_of_several_files_name_each_its_own(tmp_path):
    write(tmp_path / "config.toml", "[camera]\nhfov_deg = 500.0\n")
    write(tmp_path / "config.d" / "a.toml", "[log]\nlevel = 3\n")
    with pytest.raises(ConfigError) as caught:
        load(ConfigPlaces(tmp_path / "config.toml"))
    lines = str(caught.value).splitlines()
    assert any("config.toml: camera.hfov_deg" in line for line in lines)
    assert any("a.toml: log.level" in line for line in lines)


def test_hidden_files_and_others_are_not_read(tmp_path):
    write(tmp_path / "config.toml", "")
    write(tmp_path / "config.d" / ".a.toml", "nonsense")
    write(tmp_path / "config.d" / "a.toml~", "nonsense")
    assert load(ConfigPlaces(tmp_path / "config.toml")).config.guidance == Config().guidance


def test_text_needs_no_quotation_marks_and_lists_are_as_in_toml():
    loaded = load(
        ConfigPlaces(None, {}, ("source.url=v4l2:/dev/video0", 'link.planner=["udpin:h:1", "udpin:h:2"]'))
    )
    assert loaded.config.source.url == "v4l2:/dev/video0"
    assert [str(url) for url in loaded.config.link.planner_urls] == ["udpin:h:1", "udpin:h:2"]


def test_relative_paths_are_relative_to_the_files_folder_or_to_where_the_command_was_given(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "etc" / "config.toml", '[camera]\nfile = "camera.toml"\n')
    write(tmp_path / "etc" / "config.d" / "a.toml", '[detector]\nparams_file = "p.toml"\n')
    config = load(ConfigPlaces(tmp_path / "etc" / "config.toml", {}, ("source.url=file:walk.mp4",))).config
    assert config.camera.file == str(tmp_path / "etc" / "camera.toml")
    assert config.detector.params_file == str(tmp_path / "etc" / "p.toml")
    assert config.source.url == f"file:{tmp_path}/walk.mp4"


def test_show_prints_every_key_with_its_origin_and_reads_back(tmp_path, capsys, monkeypatch):
    place = places(tmp_path, levels=3)
    monkeypatch.setenv("VOID_COMPANION_LOG__LEVEL", "debug")
    assert main(["config", "--show", "-c", str(place.file), "-o", "camera.hfov_deg=90"]) == 0
    text = capsys.readouterr().out
    lines = {line.split(" = ")[0]: line for line in text.splitlines() if " = " in line}
    assert lines["max_step_m"].endswith("20-later.toml")
    assert lines["level"].endswith("# environment VOID_COMPANION_LOG__LEVEL")
    assert lines["hfov_deg"].split() == ["hfov_deg", "=", "90.0", "#", "-o", "camera.hfov_deg"]
    read = parse_config(text)
    assert (read.guidance.max_step_m, read.camera.hfov_deg, read.log.level) == (3.0, 90.0, "debug")
    for section, facts in Config.model_fields.items():
        for key in facts.annotation.model_fields:
            assert key in tomllib.loads(text)[section], key


def test_show_of_the_defaults_says_default_everywhere():
    lines = [line for line in shown_with_origins(load(ConfigPlaces())).splitlines() if " = " in line]
    assert lines
    assert all(line.endswith("# default") for line in lines)


def test_what_follows_from_other_settings_is_not_called_a_default(tmp_path):
    loaded = load(ConfigPlaces(places(tmp_path, levels=1).file, {}, ('detector.preset="paper"',)))
    assert (loaded.config.detector.method, loaded.origin("detector.method")) == (
        "paper",
        "follows from what is set",
    )
    assert loaded.origin("ground_station.parameters_file") == "follows from what is set"
    assert loaded.origin("detector.preset") == "-o detector.preset"
    assert loaded.origin("detector.deadline_s") == "default"
