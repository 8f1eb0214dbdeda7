from __future__ import annotations

import asyncio
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config
from companion.config_file import section_schemas
from companion.config_sources import load_config
from companion.errors import ConfigError
from companion.io.messages import Answer
from companion.web.form import settings_form, split_effect
from companion.web.settings import SettingsDesk
from companion.web.settings_file import SettingsFile, revision_of, with_values
from tests.companion.web.conftest import SETTINGS_TOML
from tests.companion.web.showcase import FakeDesk


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(SETTINGS_TOML)
    return path


@pytest.fixture
def service(path: Path) -> FakeDesk:
    return FakeDesk(load_config(path))


@pytest.fixture
def desk(path: Path, service: FakeDesk) -> SettingsDesk:
    async def apply(values: Mapping[str, Any]) -> Answer:
        return await asyncio.wrap_future(service.ask("apply_settings", {"values": values}))

    return SettingsDesk(service.active, SettingsFile(path), apply)


def content(path: Path) -> str:
    return path.read_text()


def is_there(path: Path) -> bool:
    return path.exists()


def put(path: Path, text: str) -> None:
    path.write_text(text)


def entry_of(form: dict[str, Any], key: str) -> dict[str, Any]:
    return next(entry for section in form["sections"] for entry in section["keys"] if entry["key"] == key)


def test_the_form_has_every_key_with_its_meaning_range_and_what_a_change_takes() -> None:
    form = settings_form()
    found = {entry["key"] for section in form for entry in section["keys"]}
    wanted = {f"{name}.{key}" for name, schema in section_schemas().items() for key in schema["properties"]}
    assert found == wanted
    for section in form:
        for entry in section["keys"]:
            assert entry["meaning"], entry["key"]
            assert entry["type"] in ("number", "integer", "boolean", "choice", "text", "list")
            assert entry["when"] in ("at once", "new worker", "restart")
            assert ("reason" in entry) == (entry["when"] == "restart")
    assert [section["name"] for section in form][:3] == ["guidance", "detector", "camera"]


def test_what_larger_values_do_is_told_apart() -> None:
    text = "Longest step (m). Larger: faster, longer to stop (m)."
    assert split_effect(text) == ("Longest step.", "Larger: faster, longer to stop.")
    assert split_effect("0: off. Whatever.") == ("0: off. Whatever.", "")


async def test_a_change_acts_and_is_undone(desk: SettingsDesk, service: FakeDesk) -> None:
    answer = await desk.apply({"guidance.agree_deg": 17.0, "log.level": "debug"})
    assert answer["accepted"]
    assert service.active.guidance.agree_deg == 17.0
    answer = await desk.apply({"detector.baseline_m": 0.4})
    assert answer["new_worker"] == {"detector.baseline_m": 0.4}
    form = await desk.form()
    assert form["undo"] == [["guidance.agree_deg", "log.level"], ["detector.baseline_m"]]
    assert entry_of(form, "guidance.agree_deg")["value"] == 17.0
    assert (await desk.undo())["undone"] == {"detector.baseline_m": Config().detector.baseline_m}
    assert (await desk.undo())["accepted"]
    assert service.active.guidance.agree_deg == Config().guidance.agree_deg
    assert service.active.log.level == "info"
    assert (await desk.undo())["reasons"] == ["there is nothing to undo"]


async def test_what_may_not_change_in_flight_is_refused_with_the_reason_and_nothing_is_taken(
    desk: SettingsDesk, service: FakeDesk
) -> None:
    answer = await desk.apply({"guidance.agree_deg": 17.0, "camera.mount_yaw_deg": 3.0})
    assert not answer["accepted"]
    assert answer["refused"] == {"camera.mount_yaw_deg": "the worker and the switch S are built on it"}
    assert service.active.guidance.agree_deg == Config().guidance.agree_deg
    assert (await desk.form())["undo"] == []


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("guidance.max_step_m", 500.0, "guidance.max_step_m: found 500"),
        ("guidance.max_step_m", "far", 'found "far"'),
        ("guidance.max_step", 1.0, "did you mean guidance.max_step_m"),
        ("nonsense", 1.0, "nonsense"),
        ("guidance.max_step_m", None, "guidance.max_step_m"),
        ("guidance.view_deg", 80.0, "at most half of camera.hfov_deg"),
    ],
)
async def test_a_value_that_cannot_be_is_said_before_the_service_is_asked(
    desk: SettingsDesk, service: FakeDesk, key: str, value: Any, words: str
) -> None:
    answer = await desk.apply({key: value})
    assert not answer["accepted"]
    assert words in " ".join(answer["reasons"])
    assert not service.asked


async def test_the_form_compares_with_the_file(desk: SettingsDesk, path: Path) -> None:
    await desk.apply({"guidance.max_step_m": 0.7})
    entry = entry_of(await desk.form(), "guidance.max_step_m")
    assert (entry["value"], entry["file"], entry["origin"]) == (0.7, 1.2, str(path))
    assert entry_of(await desk.form(), "guidance.agree_deg")["origin"] == ""


async def test_saving_keeps_comments_and_order(desk: SettingsDesk, path: Path) -> None:
    form = await desk.form()
    values = {"guidance.max_step_m": 0.7, "detector.method": "paper", "camera.mount_pitch_deg": 5.5}
    looked = await desk.save(values, revision=form["revision"], only_look=True)
    assert looked["accepted"]
    assert "-max_step_m = 1.2  # careful indoors" in looked["diff"]
    assert content(path) == SETTINGS_TOML
    saved = await desk.save(values, revision=form["revision"], only_look=False)
    assert saved["diff"] == looked["diff"]
    text = content(path)
    for kept in (
        "# The hall on the second floor.",
        "= 0.7  # careful indoors",
        "# The camera points a little up.",
    ):
        assert kept in text
    assert text.index("[guidance]") < text.index("[camera]") < text.index("[detector]")
    assert tomllib.loads(text)["detector"] == {"method": "paper"}
    again = await desk.save({"guidance.agree_deg": 9.0}, revision=form["revision"], only_look=False)
    assert "has changed meanwhile" in again["reasons"][0]


async def test_what_is_read_later_and_wins_is_said(desk: SettingsDesk, path: Path) -> None:
    (path.parent / "config.d").mkdir()
    (path.parent / "config.d" / "10-hall.toml").write_text("[guidance]\nmax_step_m = 0.5\n")
    form = await desk.form()
    assert entry_of(form, "guidance.max_step_m")["file"] == 0.5
    saved = await desk.save({"guidance.max_step_m": 0.7}, revision=form["revision"], only_look=False)
    assert saved["overruled"] == {"guidance.max_step_m": str(path.parent / "config.d" / "10-hall.toml")}


async def test_what_would_break_the_file_is_not_saved(desk: SettingsDesk, path: Path) -> None:
    revision = (await desk.form())["revision"]
    for values in ({"guidance.max_step_m": -1.0}, {"guidance.nothing": 1.0}, {"nothing.at_all": True}):
        answer = await desk.save(values, revision=revision, only_look=False)
        assert not answer["accepted"]
        assert answer["reasons"]
    kept_out = await desk.save({"web.host": "0.0.0.0"}, revision=revision, only_look=False)  # noqa: S104
    assert "decides who may reach" in kept_out["reasons"][0]
    assert content(path) == SETTINGS_TOML


@pytest.fixture
def under_systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give the service a state directory; return what the page then saves to."""
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    return state / "config.page.toml"


@pytest.fixture
def saving_desk(under_systemd: Path, path: Path) -> SettingsDesk:
    config = load_config(path)
    assert config.web.saved_file == str(under_systemd)
    return SettingsDesk(config, SettingsFile.of(config, path))


async def test_under_systemd_it_is_saved_where_the_service_may_write_and_read_after_the_files(
    saving_desk: SettingsDesk, under_systemd: Path, path: Path
) -> None:
    (path.parent / "config.d").mkdir()
    put(path.parent / "config.d" / "10-hall.toml", "[guidance]\nmax_step_m = 0.5\n")
    form = await saving_desk.form()
    assert (form["file"], form["saves_to"]) == (str(path), str(under_systemd))
    values = {"guidance.max_step_m": 0.7, "detector.method": "paper"}
    looked = await saving_desk.save(values, revision=form["revision"], only_look=True)
    assert "+max_step_m = 0.7" in looked["diff"]
    assert not is_there(under_systemd)
    saved = await saving_desk.save(values, revision=form["revision"], only_look=False)
    assert saved["accepted"]
    assert (saved["file"], saved["overruled"]) == (str(under_systemd), {})
    assert content(path) == SETTINGS_TOML
    assert tomllib.loads(content(under_systemd)) == {
        "guidance": {"max_step_m": 0.7},
        "detector": {"method": "paper"},
    }
    config = load_config(path)
    assert (config.guidance.max_step_m, config.detector.method) == (0.7, "paper")

    again = await saving_desk.save({"guidance.agree_deg": 9.0}, revision=form["revision"], only_look=False)
    assert "config.page.toml has changed meanwhile" in again["reasons"][0]
    put(under_systemd, content(under_systemd).replace("0.7", "0.7  # the hall"))
    form = await saving_desk.form()
    assert entry_of(form, "guidance.max_step_m")["file"] == 0.7
    saved = await saving_desk.save({"guidance.agree_deg": 9.0}, revision=form["revision"], only_look=False)
    assert saved["accepted"]
    assert "max_step_m = 0.7  # the hall\nagree_deg = 9.0" in content(under_systemd)


async def test_what_does_not_go_with_the_files_is_not_saved_beside_them(
    saving_desk: SettingsDesk, under_systemd: Path
) -> None:
    revision = (await saving_desk.form())["revision"]
    for values in ({"guidance.max_step_m": -1.0}, {"guidance.view_deg": 80.0}, {"nothing.at_all": True}):
        answer = await saving_desk.save(values, revision=revision, only_look=False)
        assert not answer["accepted"]
        assert answer["reasons"]
    assert not is_there(under_systemd)


async def test_what_a_ground_station_has_set_wins_over_what_the_page_saved_and_it_says_so(
    saving_desk: SettingsDesk, under_systemd: Path
) -> None:
    station = under_systemd.with_name("config.tuned.toml")
    put(station, "[guidance]\nmax_step_m = 0.3\n")
    revision = (await saving_desk.form())["revision"]
    saved = await saving_desk.save({"guidance.max_step_m": 0.7}, revision=revision, only_look=False)
    assert saved["overruled"] == {"guidance.max_step_m": str(station)}


async def test_a_file_that_is_named_is_saved_to_itself(under_systemd: Path, path: Path) -> None:
    put(path, f'{SETTINGS_TOML}\n[web]\nsettings_file = "{path.name}"\n')
    config = load_config(path)
    assert config.web.saved_file == ""
    desk = SettingsDesk(config, SettingsFile.of(config, Path(config.web.settings_file)))
    revision = (await desk.form())["revision"]
    saved = await desk.save({"guidance.max_step_m": 0.7}, revision=revision, only_look=False)
    assert saved["file"] == str(path)
    assert "= 0.7  # careful indoors" in content(path)
    assert not is_there(under_systemd)


async def test_a_file_that_cannot_be_used_is_said_and_the_form_still_shows_what_acts(
    desk: SettingsDesk, path: Path
) -> None:
    put(path, "[guidance\n")
    form = await desk.form()
    assert "config.toml" in form["fault"]
    assert entry_of(form, "guidance.max_step_m")["value"] == 1.2
    assert "file" not in entry_of(form, "guidance.max_step_m")


async def test_without_a_service_nothing_is_applied_and_without_a_file_nothing_is_saved() -> None:
    desk = SettingsDesk(Config(), SettingsFile(None))
    form = await desk.form()
    assert not form["live"]
    assert form["file"] is None
    assert (await desk.apply({"guidance.agree_deg": 9.0}))["reasons"] == [
        "there is no running service behind this page"
    ]
    saved = await desk.save({"guidance.agree_deg": 9.0}, revision="", only_look=False)
    assert "without a configuration file" in saved["reasons"][0]


def test_a_password_in_an_address_is_not_shown(path: Path) -> None:
    config = Config.model_validate({"source": {"url": "rtsp://me:secret@10.0.0.3/stream"}})
    form = asyncio.run(SettingsDesk(config, SettingsFile(path)).form())
    entry = entry_of(form, "source.url")
    assert entry["value"] == "rtsp://***@10.0.0.3/stream"
    assert "secret" not in str(form)


def test_values_go_into_any_form_of_table() -> None:
    text = "guidance = { max_step_m = 1.0 } # inline\n"
    new = with_values(
        text, {"guidance.max_step_m": 2.0, "guidance.agree_deg": 9.0, "log.level": "debug"}, name="c"
    )
    assert tomllib.loads(new) == {
        "guidance": {"max_step_m": 2.0, "agree_deg": 9.0},
        "log": {"level": "debug"},
    }
    assert "# inline" in new
    assert tomllib.loads(
        with_values("guidance.max_step_m = 1.0\n", {"guidance.agree_deg": 9.0}, name="c")
    ) == {"guidance": {"max_step_m": 1.0, "agree_deg": 9.0}}
    with pytest.raises(ConfigError, match="no table"):
        with_values("guidance = 5\n", {"guidance.agree_deg": 9.0}, name="c")
    assert revision_of("a") != revision_of("b")
