"""Judges what was found against what the configuration needs (pure)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from companion.config import Config
from companion.doctor.autopilot_facts import facts, version_check
from companion.doctor.check import Check, Level
from companion.doctor.findings import Findings, LinkFinding
from companion.guidance.engagement import estimator_fault
from companion.mavlink.streams import Need, needs
from companion.mavlink.telemetry import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    Heartbeat,
    vehicle_mode,
)

_HEARTBEAT: Final = 0
_LEAST_HEARTBEAT_HZ: Final = 0.7
_CRC_SHARE: Final = 0.01
_ROUND_TRIP_MS: Final = (50.0, 250.0)
_DISK_FREE_MIB: Final = (500, 100)
_MEMORY_FREE_MIB: Final = (300, 100)
_CPU_DEG_C: Final = (75.0, 85.0)
_RATE_MARGIN: Final = 2.0
"""A frame rate that is not this much above the floor falls below it with the next dark corner."""


def judge(findings: Findings, config: Config) -> tuple[Check, ...]:
    """Return the checklist, in the order in which things are to be put right."""
    checks = [*_links(findings), *_vehicle(findings, config), *_planner(findings, config)]
    checks += _camera(findings, config)
    checks += _host(findings)
    if findings.signing_fault:
        checks.append(
            Check("signing key", Level.FAIL, findings.signing_fault, "make the key file good, or name none")
        )
    return tuple(checks)


def _links(findings: Findings) -> Iterator[Check]:
    for link in findings.links:
        yield _link(link)


def _link(link: LinkFinding) -> Check:
    name, is_autopilot = f"link {link.name}", "autopilot" in link.name
    if link.state != "open":
        advice = "check address, port or device and its permissions"
        if "another program" in link.state:
            advice = "stop the companion service while the doctor listens, or end what has the port"
        return Check(name, Level.FAIL if is_autopilot else Level.WARN, f"{link.url}: {link.state}", advice)
    frames = f"{link.url}: {link.frames} frames"
    if link.frames == 0 and link.received_bytes:
        return Check(
            name,
            Level.FAIL,
            f"{frames} in {link.received_bytes} bytes",
            "what comes is not MAVLink: wrong baud rate, or the port of another program",
        )
    if link.frames == 0:
        if is_autopilot:
            advice = (
                "nothing comes: check cable, baud rate or port, and that the autopilot's MAVLink is on there"
            )
            return Check(name, Level.FAIL, frames, advice)
        return Check(name, Level.OK, f"{frames}; nobody there yet")
    bad = link.crc_errors / (link.frames + link.crc_errors)
    if bad > _CRC_SHARE:
        return Check(
            name,
            Level.WARN,
            f"{frames}, {link.crc_errors} with a wrong checksum",
            "bytes are lost: lower the baud rate, turn flow control on, shorten the cable",
        )
    return Check(name, Level.OK, frames)


def _vehicle(findings: Findings, config: Config) -> Iterator[Check]:
    vehicle = findings.vehicle
    if vehicle is None:
        yield Check("autopilot", Level.FAIL, "no HEARTBEAT of an autopilot", "the link comes first")
        return
    yield _kind(vehicle)
    if len(findings.autopilot_systems) > 1:
        ids = ", ".join(str(system) for system in sorted(findings.autopilot_systems))
        yield Check(
            "other autopilots",
            Level.WARN,
            f"system ids {ids}",
            "one vehicle a companion: give each link its own",
        )
    yield _rate(
        Need("HEARTBEAT", (_HEARTBEAT,), _LEAST_HEARTBEAT_HZ, 1.0, True, "whether it flies by setpoints"),
        findings,
    )
    for need in needs(vehicle.autopilot, config.engagement):
        yield _rate(need, findings)
    fault = estimator_fault(findings.estimator_flags)
    if fault is not None:
        yield Check(
            "estimator",
            Level.FAIL,
            fault,
            "wait until it has a position; indoors: optical flow, VIO or beacons",
        )
    elif findings.estimator_flags is not None:
        yield Check("estimator", Level.OK, f"flags {findings.estimator_flags}")
    yield version_check(vehicle.autopilot, findings.version)
    for fact in facts(vehicle.autopilot):
        if fact.name in findings.parameters:
            yield fact.judge(findings.parameters[fact.name])
        else:
            yield Check(
                fact.name, Level.WARN, "not told", "look it up in the ground station (docs/doctor.md)"
            )
    yield _clock(findings)


def _kind(vehicle: Heartbeat) -> Check:
    names = {MAV_AUTOPILOT_PX4: "PX4", MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot"}
    kind = names.get(vehicle.autopilot)
    mode = vehicle_mode(vehicle)
    found = f"{kind or f'MAV_AUTOPILOT {vehicle.autopilot}'}, system {vehicle.system_id}"
    found += ", armed" if mode.armed else ", disarmed"
    if kind is None:
        return Check("autopilot", Level.FAIL, found, "only PX4 and ArduPilot Copter are understood")
    if mode.armed:
        return Check(
            "autopilot", Level.WARN, found, "the doctor is for the ground: it asks for streams and parameters"
        )
    return Check("autopilot", Level.OK, found)


def _rate(need: Need, findings: Findings) -> Check:
    rate_hz = sum(findings.rates_hz.get(message_id, 0.0) for message_id in need.message_ids)
    found = f"{rate_hz:.1f} Hz, at least {need.least_hz:g} Hz needed"
    if rate_hz >= need.least_hz:
        return Check(need.name, Level.OK, found)
    vehicle = findings.vehicle
    if vehicle is not None and vehicle.autopilot == MAV_AUTOPILOT_PX4:
        how = "set MAV_n_MODE of that port to Onboard and MAV_n_RATE high enough"
    else:
        how = "set the SRn_* rates of that port, and its baud rate high enough"
    advice = f"tells {need.why}; it was asked for and does not come: {how}"
    return Check(need.name, Level.FAIL if need.vital else Level.WARN, found, advice)


def _clock(findings: Findings) -> Check:
    clock = findings.clock
    if clock is None:
        return Check(
            "clock", Level.WARN, "TIMESYNC not answered", "poses count as late by the link's least delay"
        )
    round_trip_ms = clock.round_trip_ns / 1e6
    found = f"offset {clock.offset_ns / 1e9:.3f} s, round trip {round_trip_ms:.1f} ms"
    if round_trip_ms > _ROUND_TRIP_MS[1]:
        return Check("clock", Level.FAIL, found, "poses come too late to be flown by: use a faster link")
    if round_trip_ms > _ROUND_TRIP_MS[0]:
        return Check(
            "clock", Level.WARN, found, "a slow link: raise its baud rate, send fewer streams over it"
        )
    return Check("clock", Level.OK, found)


def _planner(findings: Findings, config: Config) -> Iterator[Check]:
    senders = sorted(findings.planners)
    talking = [sender for sender in senders if findings.planners[sender]]
    link = config.link
    treated = [
        (system, component)
        for system, component in talking
        if link.planner_system_id in (0, system) and link.planner_component_id in (0, component)
    ]
    others = [f"{system}/{component}" for system, component in talking if (system, component) not in treated]
    if others:
        yield Check(
            "planner",
            Level.FAIL,
            f"setpoints of {', '.join(others)} would pass untouched",
            "set link.planner_system_id and planner_component_id to the planner's, or to 0",
        )
    elif len(treated) > 1:
        names = " and ".join(f"{system}/{component}" for system, component in treated)
        yield Check(
            "planner",
            Level.FAIL,
            f"setpoints of {names}",
            "let one of them send: autopilots do not arbitrate",
        )
    else:
        names = ", ".join(f"{system}/{component}" for system, component in senders) or "nobody yet"
        yield Check("planner", Level.OK, names)


def _camera(findings: Findings, config: Config) -> Iterator[Check]:
    camera, floor_hz = findings.camera, config.source.min_rate_hz
    if camera.fault:
        yield Check(
            "camera",
            Level.FAIL,
            camera.fault,
            "`companion cameras` lists what is there; name it in source.url",
        )
    else:
        found = f"{camera.width_px} x {camera.height_px}, {camera.rate_hz:.1f} Hz, at least {floor_hz:g} Hz needed"
        if camera.rate_hz < floor_hz:
            yield Check(
                "camera", Level.FAIL, found, "more light, a smaller picture, or another source.pixel_format"
            )
        elif camera.rate_hz < _RATE_MARGIN * floor_hz:
            yield Check("camera", Level.WARN, found, "near the floor: more light or a smaller picture")
        else:
            yield Check("camera", Level.OK, found)
    if camera.model_fault:
        yield Check(
            "vision", Level.FAIL, camera.model_fault, "`companion check-config` says the same; correct it"
        )
    elif camera.model_fault is not None:
        yield Check("vision", Level.OK, "the worker takes camera and detector settings")
    model = config.camera
    if not model.file and model.hfov_deg == type(model)().hfov_deg:
        yield Check(
            "camera model",
            Level.WARN,
            f"no file; {model.hfov_deg:g} deg across, the default",
            "directions are wrong by what the lens differs: `companion calibrate`, or set camera.hfov_deg",
        )
    else:
        yield Check("camera model", Level.OK, model.file or f"{model.hfov_deg:g} deg across")


def _host(findings: Findings) -> Iterator[Check]:
    host = findings.host
    if host.disk_used_mib is not None and host.disk_total_mib is not None:
        free = host.disk_total_mib - host.disk_used_mib
        yield _limited("disk", f"{free} MiB free", -free, tuple(-m for m in _DISK_FREE_MIB), "make room")
    if host.memory_used_mib is not None and host.memory_total_mib is not None:
        free = host.memory_total_mib - host.memory_used_mib
        yield _limited(
            "memory", f"{free} MiB free", -free, tuple(-m for m in _MEMORY_FREE_MIB), "end other programs"
        )
    temperature = host.cpu_temperature_deg_c
    if temperature is None:
        yield Check("CPU temperature", Level.OK, "this machine has no thermometer")
    else:
        found = f"{temperature:.0f} deg C"
        yield _limited(
            "CPU temperature", found, temperature, _CPU_DEG_C, "cool it: it slows itself down in flight"
        )


def _limited(name: str, found: str, value: float, limits: tuple[float, ...], advice: str) -> Check:
    warn, fail = limits
    if value > fail:
        return Check(name, Level.FAIL, found, advice)
    return Check(name, Level.WARN, found, advice) if value > warn else Check(name, Level.OK, found)
