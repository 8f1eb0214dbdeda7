"""Reading the configuration again in flight: what acts, what is refused and why, and that bad files change nothing."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time

import pytest
from structlog import wrap_logger
from structlog.testing import CapturingLogger

from companion.clock import RealClock
from companion.config import Config
from companion.config_file import parse_config
from companion.config_reload_rules import WhenChanged, changes_between, when_changed, with_changes
from companion.config_sources import ConfigPlaces, load
from companion.errors import ConfigError
from companion.guidance.engagement import Answer
from companion.log import LevelGate
from companion.reload import Reload
from companion.settings import Settings
from companion.systemd import ServiceNotifier
from companion.tuning import SETTINGS
from companion.vision.supervisor import VisionSupervisor

DEADLINE_S = 30.0


async def until(condition) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end_s, "did not come"
        await asyncio.sleep(0.01)


class Bench:
    """The real settings, supervisor and notifier about a reload of the files in a folder."""

    def __init__(self, folder, text: str, *, watch_s: float = 0.0, address: str | None = None) -> None:
        self.file = folder / "config.toml"
        self.watch = f"[reload]\nwatch_s = {watch_s}\n"
        self.write(text)
        places = ConfigPlaces(self.file)
        config = load(places).config
        captured = CapturingLogger()

        def as_call(logger, method, event):
            return (event.pop("event"),), event

        self.calls = captured.calls
        self.gate = LevelGate("info")
        log = wrap_logger(captured, processors=[self.gate, as_call]).bind()
        self.applied: list[Config] = []
        self.said: list[str] = []
        clock = RealClock()
        self.settings = Settings(
            config,
            apply=self.applied.append,
            engaged=lambda: False,
            engage=lambda on, now_ns, by: Answer(accepted=True),
            is_armed=lambda: True,
            log=log,
        )
        self.vision = VisionSupervisor(
            config.detector, config.camera, clock=clock, on_report=lambda report: None, log=log
        )
        self.notifier = ServiceNotifier(address)
        self.reload = Reload(
            places,
            config,
            settings=self.settings,
            vision=self.vision,
            notifier=self.notifier,
            say=lambda severity, text: self.said.append(text),
            gate=self.gate,
            clock=clock,
            log=log,
        )

    def write(self, text: str) -> None:
        self.file.write_text(text + "\n" + self.watch)

    def events(self, name: str) -> list[dict]:
        return [call.kwargs for call in self.calls if call.args == (name,)]

    @contextlib.asynccontextmanager
    async def running(self):
        task = asyncio.create_task(self.reload.run())
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            self.notifier.close()

    async def reloaded(self, name: str = "config_reloaded") -> dict:
        before = len(self.events(name))
        self.reload.request()
        await until(lambda: len(self.events(name)) > before)
        return self.events(name)[-1]


async def test_guidance_and_log_level_act_at_once(tmp_path):
    bench = Bench(tmp_path, "[guidance]\nmax_step_m = 2.0")
    async with bench.running():
        bench.write('[guidance]\nmax_step_m = 1.0\n[log]\nlevel = "debug"')
        event = await bench.reloaded()
    assert event["changed"] == {"guidance.max_step_m": 1.0, "log.level": "debug"}
    assert event["new_worker"] is False
    assert bench.applied[-1].guidance.max_step_m == 1.0
    assert bench.gate(None, "debug", {"event": "x"}) == {"event": "x"}
    assert "void: settings taken: max_step_m, level" in bench.said


async def test_what_cannot_change_is_refused_with_the_reason_and_the_rest_is_taken(tmp_path):
    bench = Bench(tmp_path, "")
    async with bench.running():
        bench.write(
            '[source]\nurl = "v4l2:/dev/video7"\n[camera]\nhfov_deg = 80.0\n[link]\ncomponent_id = 192\n[guidance]\nmax_step_m = 1.0'
        )
        await bench.reloaded()
        await until(lambda: bench.events("config_needs_restart"))
    reasons = bench.events("config_needs_restart")[0]["reasons"]
    assert reasons == {
        "source.url": "the frame source is open",
        "camera.hfov_deg": "the worker and the switch S are built on it",
        "link.component_id": "the links are open",
    }
    active = bench.settings.active
    assert (active.source.url, active.camera.hfov_deg, active.link.component_id) == ("", 70.0, 191)
    assert active.guidance.max_step_m == 1.0
    assert any(text.startswith("void: need a restart: ") for text in bench.said)


@pytest.mark.parametrize("bad", ["[guidance", "[guidance]\nmax_step_m = -1.0", "[guidance]\nmax_stepp = 1.0"])
async def test_a_bad_file_changes_nothing_and_is_announced(tmp_path, bad):
    bench = Bench(tmp_path, "[guidance]\nmax_step_m = 2.0\nagree_deg = 10.0")
    async with bench.running():
        before = bench.settings.active
        bench.write(bad)
        event = await bench.reloaded("config_rejected")
        assert bench.settings.active is before
        assert bench.applied == []
        assert "config.toml" in event["error"]
        assert bench.said[-1].startswith("void: settings not taken: ")
        bench.write("[guidance]\nmax_step_m = 1.0")  # and a good one is taken after it
        await bench.reloaded()
        assert bench.settings.active.guidance.max_step_m == 1.0


async def test_a_file_that_is_gone_changes_nothing(tmp_path):
    bench = Bench(tmp_path, "[guidance]\nmax_step_m = 2.0")
    async with bench.running():
        bench.file.unlink()
        event = await bench.reloaded("config_rejected")
    assert "no such file" in event["error"]
    assert bench.settings.active.guidance.max_step_m == 2.0


async def test_new_values_that_do_not_go_with_what_needs_a_restart_are_not_taken(tmp_path):
    bench = Bench(tmp_path, "[camera]\nhfov_deg = 70.0")
    async with bench.running():
        bench.write("[camera]\nhfov_deg = 120.0\n[guidance]\nview_deg = 50.0")  # good after a restart only
        event = await bench.reloaded("config_rejected")
    assert "guidance.view_deg: found 50.0; allowed: at most half of camera.hfov_deg" in event["error"]


async def test_what_a_ground_station_has_set_outlives_a_reload_also_where_it_cannot_be_written(tmp_path):
    bench = Bench(tmp_path, "[guidance]\nmax_step_m = 2.0")
    async with bench.running():
        assert bench.settings.set_number("VOID_MAX_STEP_M", 0.5, 0) is None  # nobody writes it here
        bench.write("[guidance]\nmax_step_m = 3.0\nagree_deg = 10.0")
        await bench.reloaded()
    guidance = bench.settings.active.guidance
    assert (guidance.max_step_m, guidance.agree_deg) == (0.5, 10.0)


async def test_a_saved_file_and_a_new_drop_in_are_noticed(tmp_path):
    bench = Bench(tmp_path, "[guidance]\nmax_step_m = 2.0", watch_s=0.05)
    async with bench.running():
        bench.write("[guidance]\nmax_step_m = 1.25")
        await until(lambda: bench.settings.active.guidance.max_step_m == 1.25)
        folder = tmp_path / "config.d"
        folder.mkdir()
        (folder / "room.toml").write_text("[guidance]\nagree_deg = 9.0\n")
        await until(lambda: bench.settings.active.guidance.agree_deg == 9.0)


async def test_systemd_hears_of_the_reload_and_of_its_end(tmp_path):
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.bind(str(tmp_path / "notify"))
    listener.settimeout(DEADLINE_S)
    with listener:
        bench = Bench(tmp_path, "", address=str(tmp_path / "notify"))
        bench.notifier.reloading(1)  # nothing before it is ready
        bench.notifier.reloaded()
        bench.notifier.ready()
        async with bench.running():
            bench.write("[guidance")
            await bench.reloaded("config_rejected")
            datagrams = [await asyncio.to_thread(listener.recv, 4096) for _ in range(3)]
    assert datagrams[0] == b"READY=1"
    assert datagrams[1].startswith(b"RELOADING=1\nMONOTONIC_USEC=")
    assert datagrams[2] == b"READY=1"


@pytest.mark.slow
async def test_other_detector_parameters_replace_the_worker_and_bad_ones_leave_it(tmp_path):
    bench = Bench(tmp_path, "")
    async with bench.running():
        vision = asyncio.create_task(bench.vision.run())
        try:
            await asyncio.wait_for(bench.vision.wait_ready(), DEADLINE_S)
            first = bench.vision.status.pid
            bench.write('[detector]\nparams_file = "missing.toml"')
            event = await bench.reloaded("config_rejected")
            assert "missing.toml" in event["error"]
            assert bench.vision.status.pid == first
            bench.write('[detector]\npreset = "paper"')
            event = await bench.reloaded()
            assert event["new_worker"] is True
            await until(lambda: len(bench.events("worker_ready")) == 2)
            assert bench.vision.status.pid not in (None, first)
            assert len(bench.events("worker_replaced")) == 1
            assert bench.events("worker_died") == []
        finally:
            vision.cancel()
            await asyncio.gather(vision, return_exceptions=True)


def test_every_key_has_its_rule_and_what_a_ground_station_may_change_in_flight_acts_at_once():
    for setting in SETTINGS:
        expected = WhenChanged.AT_ONCE if setting.live else WhenChanged.RESTART
        assert when_changed(setting.key) is expected, setting.key


def test_changes_are_only_what_differs_and_what_acts_keeps_the_rest():
    active = parse_config(
        '[camera]\nhfov_deg = 80.0\n[guidance]\nmax_step_m = 2.0\n[detector]\nmethod = "paper"'
    )
    assert not changes_between(active, active).any
    new = parse_config(
        '[camera]\nhfov_deg = 90.0\n[guidance]\nmax_step_m = 1.0\n[detector]\nmethod = "paper"\npreset = "paper"'
    )
    changes = changes_between(active, new)
    assert dict(changes.at_once) == {"guidance.max_step_m": 1.0}
    assert dict(changes.new_worker) == {"detector.preset": "paper"}
    assert list(changes.refused) == ["camera.hfov_deg"]
    taken = with_changes(active, changes)
    assert (taken.camera.hfov_deg, taken.guidance.max_step_m, taken.detector.preset) == (80.0, 1.0, "paper")
    with pytest.raises(ConfigError):
        with_changes(
            active,
            changes_between(active, parse_config("[camera]\nhfov_deg = 120.0\n[guidance]\nview_deg = 50.0")),
        )
