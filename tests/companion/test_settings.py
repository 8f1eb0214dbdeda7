"""Settings in force: applied, refused, kept."""

from __future__ import annotations

import asyncio
import contextlib

from structlog.testing import CapturingLogger

from companion.config import Config, GroundStationConfig
from companion.config_sources import load_config
from companion.guidance.engagement import Answer
from companion.settings import ENGAGE, Settings


class Bench:
    def __init__(self, config: Config | None = None) -> None:
        self.applied: list[Config] = []
        self.armed = False
        self.engaged = True
        self.may_engage = True
        self.settings = Settings(
            config or Config(),
            apply=self.applied.append,
            engaged=lambda: self.engaged,
            engage=self.engage,
            is_armed=lambda: self.armed,
            log=CapturingLogger(),
        )

    def engage(self, on: bool, now_ns: int, source: str) -> Answer:
        if not self.may_engage:
            return Answer(self.engaged, False, ("pose too old", "no frames"))
        self.engaged = on
        return Answer(on, True)

    def set(self, name: str, number: float) -> str | None:
        return self.settings.set_number(name, number, 0)


def test_a_live_setting_acts_at_once():
    bench = Bench()
    assert bench.set("VOID_MAX_STEP_M", 0.5) is None
    assert [config.guidance.max_step_m for config in bench.applied] == [0.5]
    assert bench.settings.number("VOID_MAX_STEP_M") == 0.5


def test_the_same_value_again_changes_nothing():
    bench = Bench()
    assert bench.set("VOID_MAX_STEP_M", 1.5) is None
    assert bench.applied == []


def test_what_needs_a_restart_is_shown_and_does_not_act():
    bench = Bench()
    assert bench.set("VOID_CAM_PITCH", 10.0) is None
    assert bench.applied == []
    assert bench.settings.number("VOID_CAM_PITCH") == 10.0
    assert bench.set("VOID_MAX_STEP_M", 0.5) is None
    assert bench.applied[-1].camera.mount_pitch_deg == 0.0


def test_a_refused_value_changes_nothing():
    bench = Bench()
    assert "allowed: number above 0" in (bench.set("VOID_MAX_STEP_M", -1.0) or "")
    assert bench.applied == []
    assert bench.settings.number("VOID_MAX_STEP_M") == 1.5


def test_changes_can_be_kept_to_the_ground():
    bench = Bench(Config(ground_station=GroundStationConfig(set_parameters="disarmed")))
    bench.armed = True
    assert "set_parameters is disarmed" in (bench.set("VOID_MAX_STEP_M", 0.5) or "")
    assert bench.set(ENGAGE, 0.0) is None  # not a setting
    bench.armed = False
    assert bench.set("VOID_MAX_STEP_M", 0.5) is None
    never = Bench(Config(ground_station=GroundStationConfig(set_parameters="never")))
    assert "set_parameters is never" in (never.set("VOID_MAX_STEP_M", 0.5) or "")


def test_engaging_is_a_parameter_too():
    bench = Bench()
    assert bench.settings.number(ENGAGE) == 1.0
    assert bench.set(ENGAGE, 0.0) is None
    assert (bench.engaged, bench.settings.number(ENGAGE)) == (False, 0.0)
    bench.may_engage = False
    assert bench.set(ENGAGE, 1.0) == "pose too old; no frames"
    assert "allowed: 0 or 1" in (bench.set(ENGAGE, 0.5) or "")
    assert bench.settings.number(ENGAGE) == 0.0


async def kept(bench: Bench, complaints: list[str], done) -> None:
    """Run the loop that writes until ``done()``."""
    task = asyncio.create_task(bench.settings.keep(complaints.append))
    try:
        async with asyncio.timeout(30):
            while not done():  # noqa: ASYNC110  a condition of the file system has no event
                await asyncio.sleep(0.01)
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def test_changes_are_there_after_a_restart(tmp_path):
    path = tmp_path / "drone.toml"
    path.write_text("")
    bench = Bench(load_config(path))
    assert bench.set("VOID_MAX_STEP_M", 0.5) is None
    assert bench.set("VOID_CAM_PITCH", -12.5) is None
    await kept(bench, [], (tmp_path / "drone.tuned.toml").exists)
    again = load_config(path)
    assert (again.guidance.max_step_m, again.camera.mount_pitch_deg) == (0.5, -12.5)


async def test_what_cannot_be_kept_is_said_once_and_kept_later(tmp_path):
    folder = tmp_path / "later"
    station = GroundStationConfig(parameters_file=str(folder / "x.toml"))
    bench = Bench(Config(ground_station=station))
    complaints: list[str] = []
    assert bench.set("VOID_MAX_STEP_M", 0.5) is None
    await kept(bench, complaints, lambda: complaints)
    assert "No such file" in complaints[0]
    folder.mkdir()
    assert bench.set("VOID_AGREE_DEG", 20.0) is None
    await kept(bench, complaints, (folder / "x.toml").exists)
    text = (folder / "x.toml").read_text()
    assert "max_step_m = 0.5" in text
    assert "agree_deg = 20.0" in text
    assert len(complaints) == 1


async def test_without_a_configuration_file_it_says_so():
    bench = Bench()
    complaints: list[str] = []
    bench.set("VOID_MAX_STEP_M", 0.5)
    await kept(bench, complaints, lambda: complaints)
    assert "lost with a restart" in complaints[0]
