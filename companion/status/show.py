"""A status as text for people (pure)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

_NAME_WIDTH: Final = 11
_ACTIONS: Final = ("forwarded", "substituted", "held", "turned")


def status_text(status: Mapping[str, Any]) -> str:
    """Return a snapshot of the service (``companion.status.snapshot``) as some lines."""
    lines = [
        f"void-companion {status['version']}, up {duration(status['uptime_s'])} (pid {status['pid']})",
        _line("state", _state(status)),
        _line("frames", _frames(status)),
        _line("answers", _answers(status)),
        _line("pose", _pose(status)),
        _line("autopilot", _autopilot(status)),
        _line("setpoints", _setpoints(status)),
        _line("worker", _worker(status["worker"])),
        *_links(status["links"]),
        _line("computer", _host(status["host"])),
        _line("processes", _processes(status["processes"])),
    ]
    lines += [_line(name, _flat(part)) for name, part in status.items() if name not in _KNOWN]
    return "\n".join(lines) + "\n"


_KNOWN: Final = frozenset(
    {
        *("running", "version", "pid", "uptime_s", "state", "reason", "not_ready", "frames_hz", "reports_hz"),
        *("setpoints_hz", "pose_age_ms", "pose", "heading_deg", "report", "setpoint", "engaged"),
        *("clock_round_trip_ms", "armed", "autopilot_age_ms", "source", "worker", "links", "counts"),
        *("host", "processes"),
    }
)


def duration(seconds: float) -> str:
    """Return a time in words: ``42 s``, ``3 min 5 s``, ``2 h 13 min``, ``4 d 2 h``."""
    whole = int(seconds)
    for unit, unit_s, below, below_s in (
        ("d", 86400, "h", 3600),
        ("h", 3600, "min", 60),
        ("min", 60, "s", 1),
    ):
        if whole >= unit_s:
            return f"{whole // unit_s} {unit} {whole % unit_s // below_s} {below}"
    return f"{whole} s"


def age(age_ms: float | None) -> str:
    """Return an age in words, or ``never``."""
    if age_ms is None:
        return "never"
    return f"{age_ms} ms old" if age_ms < 10_000 else f"{duration(age_ms / 1000)} old"


def _line(name: str, text: str) -> str:
    return f"{name:<{_NAME_WIDTH}}{text}"


def _state(status: Mapping[str, Any]) -> str:
    words = [f"{status['state']}: {status['reason']}" if status["reason"] else str(status["state"])]
    words.append("protection wanted" if status["engaged"] else "protection NOT wanted")
    words.append("armed" if status["armed"] else "disarmed")
    if status["not_ready"]:
        words.append(f"not ready: {status['not_ready']}")
    return "; ".join(words)


def _frames(status: Mapping[str, Any]) -> str:
    source = status["source"]
    fault = f"; FAULT: {source['fault']}" if source["fault"] else ""
    return f"{status['frames_hz']}/s, newest {age(source['frame_age_ms'])}, {source['url'] or 'no source'}{fault}"


def _answers(status: Mapping[str, Any]) -> str:
    report = status.get("report")
    text = f"{status['reports_hz']}/s"
    if report is None:
        return f"{text}, none yet"
    why = f" ({report['reason']})" if report.get("reason") else ""
    far = f", {report['distance_m']} m" if "distance_m" in report else ""
    return (
        f"{text}, newest {report['kind']}{why}{far}, {age(report['age_ms'])}, took {report['detector_ms']} ms"
    )


def _pose(status: Mapping[str, Any]) -> str:
    text = age(status["pose_age_ms"])
    if "pose" in status:
        north_m, east_m, down_m = status["pose"]
        text += (
            f"; north {north_m}, east {east_m}, down {down_m} m, heading {status.get('heading_deg')} degrees"
        )
    return text


def _autopilot(status: Mapping[str, Any]) -> str:
    round_trip_ms = status["clock_round_trip_ms"]
    clock = "clock not compared" if round_trip_ms is None else f"clock within {round_trip_ms} ms"
    return f"heartbeat {age(status['autopilot_age_ms'])}, {clock}"


def _setpoints(status: Mapping[str, Any]) -> str:
    counts = status["counts"]
    actions = ", ".join(f"{counts[action]} {action}" for action in _ACTIONS)
    dropped = sum(counts["dropped"].values())
    unprotected = sum(counts["unprotected"].values())
    return f"{status['setpoints_hz']}/s; {actions}, {dropped} dropped, {unprotected} unprotected"


def _worker(worker: Mapping[str, Any]) -> str:
    pid = f" (pid {worker['pid']})" if worker["pid"] else ""
    error = f"; last error: {worker['last_error'].splitlines()[0]}" if worker["last_error"] else ""
    return f"{worker['state']}{pid}, {worker['restarts']} restarts, {worker['frames_replaced']} frames replaced{error}"


def _links(links: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [
        _line(
            "link" if number == 0 else "",
            f"{name}  {link['url']}  {link['state']}, {link['peers']} peers, in {_bytes(link['received_bytes'])}, "
            f"out {_bytes(link['sent_bytes'])}, {link['crc_errors']} checksum errors, {link['sequence_gaps']} lost, "
            f"{link['drops']} not taken, {link['late_setpoints']} setpoints too late",
        )
        for number, (name, link) in enumerate(links.items())
    ]


def _host(host: Mapping[str, Any]) -> str:
    parts = []
    if host["cpu_load"] is not None:
        parts.append(f"load {100 * host['cpu_load']:.0f} %")
    for name, label in (("memory", "memory"), ("disk", "disk")):
        used, total = host[f"{name}_used_mib"], host[f"{name}_total_mib"]
        if used is not None and total is not None:
            parts.append(f"{label} {used} of {total} MiB")
    parts += [f"{zone} {degrees} C" for zone, degrees in host["temperatures_deg_c"].items()]
    return ", ".join(parts) or "not known"


def _processes(processes: Mapping[str, Mapping[str, Any]]) -> str:
    return ", ".join(
        f"{name} gone"
        if use["rss_mib"] is None or use["cpu_s"] is None
        else f"{name} {use['rss_mib']} MiB, {use['cpu_s']:.1f} s of processor"
        for name, use in processes.items()
    )


def _flat(part: object) -> str:
    if isinstance(part, Mapping):
        return ", ".join(f"{name} {_plain(value)}" for name, value in part.items() if value not in ("", None))
    return _plain(part)


def _plain(value: object) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)


def _bytes(count: int) -> str:
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} B"
