"""What sinks may ask the service for: settings in flight with their refusals, recordings, a word to the ground station."""

from __future__ import annotations

import time

import pytest

from companion.config_reload_rules import Changes
from companion.errors import CompanionError, ConfigError
from companion.io.desk import ServiceDesk
from companion.io.feed import Feed
from companion.mavlink.identity import MavSeverity
from tests.companion.test_reload import Bench


class Voice:
    def __init__(self) -> None:
        self.said: list[tuple[MavSeverity, str]] = []

    def status_text(self, severity, text):
        self.said.append((severity, text))


def desk(apply_settings=None, *, has_recorder=True):
    feed, voice = Feed(), Voice()
    made = ServiceDesk(
        feed, voice, now_ns=time.monotonic_ns, has_recorder=has_recorder, apply_settings=apply_settings
    )
    return made, feed, voice


def told(feed: Feed):
    from companion.io.messages import unpack

    return [dict(message.fields) for packet, _ in feed.packets() for message in unpack(packet)]


async def test_settings_act_in_flight_and_what_needs_a_restart_takes_nothing(tmp_path):
    bench = Bench(tmp_path, "[guidance]\nmax_step_m = 2.0\n")
    made, _, _ = desk(bench.reload.apply)
    apply = made.handlers["apply_settings"]
    answer = await apply({"values": {"guidance.max_step_m": 1.0, "log.level": "debug"}})
    assert answer.accepted
    assert answer.fields["at_once"] == {"guidance.max_step_m": 1.0, "log.level": "debug"}
    assert bench.applied[-1].guidance.max_step_m == 1.0
    assert bench.settings.kept.guidance.max_step_m == 1.0
    assert "void: settings taken: max_step_m, level" in bench.said
    answer = await apply({"values": {"guidance.max_step_m": 0.5, "camera.hfov_deg": 80.0}})
    assert not answer.accepted
    assert answer.reasons == (
        "camera.hfov_deg: needs a restart, the worker and the switch S are built on it",
    )
    assert list(answer.fields["refused"]) == ["camera.hfov_deg"]
    assert bench.settings.active.guidance.max_step_m == 1.0  # all or none


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"guidance.max_step_m": -1.0}, "max_step_m"),
        ({"guidance.no_such_key": 1}, "no_such_key"),
        ({"nothing": 1}, "TABLE.KEY"),
        ({}, "expected values"),
    ],
)
async def test_what_cannot_be_used_is_refused_with_the_reason(tmp_path, values, reason):
    bench = Bench(tmp_path, "")
    made, _, _ = desk(bench.reload.apply)
    answer = await made.handlers["apply_settings"]({"values": values})
    assert not answer.accepted
    assert reason in answer.reasons[0]
    assert bench.applied == []


async def test_where_settings_hold_for_the_whole_run_that_is_said():
    made, _, _ = desk(None)
    answer = await made.handlers["apply_settings"]({"values": {"guidance.max_step_m": 1.0}})
    assert answer.reasons == ("settings hold for the whole run",)


async def test_a_refusal_of_the_reload_is_the_answer():
    async def refuse(values) -> Changes:
        raise ConfigError("guidance.max_step_m: no")

    made, _, _ = desk(refuse)
    answer = await made.handlers["apply_settings"]({"values": {"guidance.max_step_m": 1.0}})
    assert answer.reasons == ("guidance.max_step_m: no",)


async def test_recordings_are_begun_where_there_is_a_recorder():
    made, feed, _ = desk()
    assert (await made.handlers["record"]({"on": True})).accepted
    assert told(feed) == [{"name": "record", "on": True}]
    assert not (await made.handlers["record"]({"on": "yes"})).accepted
    await made.handlers["recorder_state"]({"recording": True, "file": "x"})
    assert made.recorder_status(0) == {"recording": True, "file": "x"}
    without, feed, _ = desk(has_recorder=False)
    with pytest.raises(CompanionError, match=r'recorder\.start is "never"'):
        without.record({"on": True})
    assert told(feed) == []


async def test_arming_is_told_once_and_sinks_speak_to_the_ground_station():
    made, feed, voice = desk()
    for armed in (False, False, True, True, False):
        made.note_armed(armed, 1)
    assert [fields["on"] for fields in told(feed)] == [False, True, False]
    await made.handlers["announce"]({"text": "recording stopped, disk full", "problem": True})
    await made.handlers["announce"]({"text": "x" * 500})
    assert voice.said[0] == (MavSeverity.WARNING, "void: recording stopped, disk full")
    assert voice.said[1][0] is MavSeverity.INFO
    assert len(voice.said[1][1]) <= 210
