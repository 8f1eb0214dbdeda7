"""Judgements: what fails, what is to be looked at, and that each says what to do."""

from __future__ import annotations

import dataclasses
import json

import pytest

from companion.config import CameraConfig, Config, EngagementConfig, LinkConfig, SourceConfig
from companion.doctor.check import Level
from companion.doctor.checks import judge
from companion.doctor.findings import CameraFinding, Findings, LinkFinding
from companion.doctor.report import as_json, as_text, exit_code
from companion.host_status import HostStatus
from companion.mavlink.telemetry import Heartbeat
from companion.mavlink.timesync import ClockSync

PX4 = Heartbeat(1, 1, 2, 12, 1, 4 << 16 | 3 << 24, 3)
COPTER = Heartbeat(1, 1, 2, 3, 1, 0, 3)
CONFIG = Config(camera=CameraConfig(hfov_deg=80.0))
GOOD = Findings(
    links=(
        LinkFinding("planner", "udpin:x:1", "open"),
        LinkFinding("autopilot", "udpin:x:2", "open", 5000, 100),
    ),
    vehicle=PX4,
    autopilot_systems=frozenset({1}),
    rates_hz={0: 1.0, 30: 98.0, 32: 29.5, 230: 1.0},
    version=(1, 16, 1),
    parameters={"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 5.0, "COM_RC_OVERRIDE": 3.0},
    clock=ClockSync(5_000_000_000, 3_000_000, 0),
    estimator_flags=831,
    planners={(255, 190): False, (245, 190): True},
    signing_fault="",
    camera=CameraFinding("", 30.0, 640, 480, ""),
    host=HostStatus(100.0, 0.2, 55.0, 1000, 4000, 5000, 32000),
)


def with_(**changes) -> Findings:
    return dataclasses.replace(GOOD, **changes)


def levels(findings: Findings, config: Config = CONFIG) -> dict[str, Level]:
    return {check.name: check.level for check in judge(findings, config)}


def test_when_all_is_good_nothing_is_to_be_done():
    checks = judge(GOOD, CONFIG)
    assert {check.level for check in checks} == {Level.OK}
    assert not any(check.advice for check in checks)
    assert exit_code(checks) == 0


@pytest.mark.parametrize(
    ("changes", "name", "level", "advice"),
    [
        ({"vehicle": None}, "autopilot", Level.FAIL, "link"),
        ({"vehicle": dataclasses.replace(PX4, autopilot=0)}, "autopilot", Level.FAIL, "PX4 and ArduPilot"),
        ({"vehicle": dataclasses.replace(PX4, base_mode=129)}, "autopilot", Level.WARN, "ground"),
        ({"autopilot_systems": frozenset({1, 2})}, "other autopilots", Level.WARN, "one vehicle"),
        ({"rates_hz": {0: 1.0, 30: 98.0, 230: 1.0}}, "LOCAL_POSITION_NED", Level.FAIL, "MAV_n_MODE"),
        ({"rates_hz": {0: 1.0, 32: 30.0, 230: 1.0, 30: 5.0}}, "ATTITUDE", Level.FAIL, "looks"),
        ({"rates_hz": {0: 1.0, 32: 30.0, 30: 98.0}}, "ESTIMATOR_STATUS", Level.WARN, "healthy"),
        ({"rates_hz": {0: 0.3, 32: 30.0, 30: 98.0, 230: 1.0}}, "HEARTBEAT", Level.FAIL, "setpoints"),
        ({"estimator_flags": 1}, "estimator", Level.FAIL, "position"),
        ({"version": None}, "autopilot version", Level.WARN, "both ways"),
        ({"version": (1, 13, 3)}, "autopilot version", Level.WARN, "1.14 to 1.17"),
        ({"parameters": {}}, "COM_OF_LOSS_T", Level.WARN, "look it up"),
        ({"clock": None}, "clock", Level.WARN, "least delay"),
        ({"clock": ClockSync(0, 100_000_000, 0)}, "clock", Level.WARN, "slow link"),
        ({"clock": ClockSync(0, 400_000_000, 0)}, "clock", Level.FAIL, "faster link"),
        ({"planners": {(1, 191): True, (245, 190): True}}, "planner", Level.FAIL, "arbitrate"),
        ({"camera": CameraFinding("no such device")}, "camera", Level.FAIL, "companion cameras"),
        ({"camera": CameraFinding("", 1.5, 640, 480, "")}, "camera", Level.FAIL, "light"),
        ({"camera": CameraFinding("", 3.0, 640, 480, "")}, "camera", Level.WARN, "floor"),
        ({"camera": CameraFinding("", 30.0, 640, 480, "bad file")}, "vision", Level.FAIL, "check-config"),
        ({"signing_fault": "key: no such file"}, "signing key", Level.FAIL, "key file"),
        ({"host": dataclasses.replace(GOOD.host, disk_used_mib=31_700)}, "disk", Level.WARN, "room"),
        ({"host": dataclasses.replace(GOOD.host, disk_used_mib=31_950)}, "disk", Level.FAIL, "room"),
        ({"host": dataclasses.replace(GOOD.host, memory_used_mib=3_950)}, "memory", Level.FAIL, "programs"),
        (
            {"host": dataclasses.replace(GOOD.host, cpu_temperature_deg_c=80.0)},
            "CPU temperature",
            Level.WARN,
            "cool",
        ),
        (
            {"host": dataclasses.replace(GOOD.host, cpu_temperature_deg_c=90.0)},
            "CPU temperature",
            Level.FAIL,
            "cool",
        ),
    ],
)
def test_each_fault_is_named_with_what_to_do(changes, name, level, advice):
    checks = judge(with_(**changes), CONFIG)
    (found,) = [check for check in checks if check.name == name]
    assert found.level is level
    assert advice in found.advice
    assert exit_code(checks) == (level is Level.FAIL)


@pytest.mark.parametrize(
    ("link", "level", "advice"),
    [
        (LinkFinding("autopilot", "u", "open"), Level.FAIL, "nothing comes"),
        (LinkFinding("autopilot", "u", "open", 900, 0), Level.FAIL, "not MAVLink"),
        (LinkFinding("autopilot", "u", "open", 9000, 90, 10), Level.WARN, "bytes are lost"),
        (
            LinkFinding("autopilot", "u", "cannot listen; another program has this port"),
            Level.FAIL,
            "stop the companion",
        ),
        (LinkFinding("autopilot", "u", "waiting for the device"), Level.FAIL, "permissions"),
        (LinkFinding("planner", "u", "open"), Level.OK, ""),
    ],
)
def test_links(link, level, advice):
    checks = judge(with_(links=(link,)), CONFIG)
    assert checks[0].level is level
    assert advice in checks[0].advice


@pytest.mark.parametrize(
    ("name", "value", "level"),
    [
        ("COM_OF_LOSS_T", 1.0, Level.OK),
        ("COM_OF_LOSS_T", 5.0, Level.WARN),
        ("COM_OF_LOSS_T", 0.1, Level.WARN),
        ("COM_OBL_RC_ACT", 0.0, Level.WARN),
        ("COM_OBL_RC_ACT", 3.0, Level.WARN),
        ("COM_OBL_RC_ACT", 4.0, Level.OK),
        ("COM_RC_OVERRIDE", 1.0, Level.WARN),
        ("COM_RC_OVERRIDE", 3.0, Level.OK),
    ],
)
def test_parameters_of_px4(name, value, level):
    assert levels(with_(parameters={**GOOD.parameters, name: value}))[name] is level


def test_ardupilot_is_judged_by_its_own():
    rates = {0: 1.0, 30: 50.0, 32: 30.0, 193: 1.0, 33: 5.0}
    found = with_(vehicle=COPTER, version=(4, 6, 0), parameters={"GUID_TIMEOUT": 3.0}, rates_hz=rates)
    assert set(levels(found).values()) == {Level.OK}
    slow = dataclasses.replace(found, parameters={"GUID_TIMEOUT": 10.0})
    assert levels(slow)["GUID_TIMEOUT"] is Level.WARN
    assert "SRn" in as_text(judge(dataclasses.replace(found, rates_hz={0: 1.0}), CONFIG))


def test_what_is_needed_depends_on_the_configuration():
    by_rc = Config(camera=CameraConfig(hfov_deg=80.0), engagement=EngagementConfig(by="rc"))
    assert levels(GOOD, by_rc)["RC_CHANNELS"] is Level.FAIL
    assert "RC_CHANNELS" not in levels(GOOD)
    fast = Config(camera=CameraConfig(hfov_deg=80.0), source=SourceConfig(min_rate_hz=50.0))
    assert levels(GOOD, fast)["camera"] is Level.FAIL
    assert levels(GOOD, Config())["camera model"] is Level.WARN
    other = Config(camera=CameraConfig(hfov_deg=80.0), link=LinkConfig(planner_system_id=7))
    assert levels(GOOD, other)["planner"] is Level.FAIL


def test_the_report_is_for_people_and_for_programs():
    checks = judge(with_(camera=CameraFinding("no such device")), CONFIG)
    text = as_text(checks)
    assert "[FAIL] camera" in text
    assert "-> `companion cameras` lists" in text
    assert f"{len(checks)} checks: 1 failed, 0 to look at" in text
    read = json.loads(as_json(checks))
    assert read["ok"] is False
    assert {"name", "level", "found", "advice"} == set(read["checks"][0])
