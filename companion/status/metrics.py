"""A snapshot of the service as Prometheus metrics, written by the official client library (pure).

Names follow https://prometheus.io/docs/practices/naming/: base units in the name, ``_total`` for what only grows. The
library is imported where it is needed: a service without metrics does not load it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from companion.guidance.substitution import State

if TYPE_CHECKING:
    from prometheus_client.core import Metric

_PREFIX: Final = "void_companion_"
_MIB: Final = 1 << 20

Encoder = Callable[[Mapping[str, Any], str], tuple[bytes, str]]
"""Takes a snapshot and the Accept header of the request, returns the text and its content type."""

_ACTIONS: Final = ("forwarded", "substituted", "held", "turned")
_LINK_COUNTERS: Final = (
    ("received_bytes", "received_bytes", "Bytes received."),
    ("sent_bytes", "sent_bytes", "Bytes sent, once for each peer."),
    ("received_frames", "received_frames", "MAVLink frames received."),
    ("crc_errors", "checksum_errors", "Frames received with a wrong checksum."),
    ("sequence_gaps", "lost_frames", "Frames lost before they came here, by their sequence numbers."),
    ("drops", "send_drops", "Datagrams that the kernel did not take."),
    ("filtered", "filtered_frames", "Frames that a filter kept back."),
    ("late_setpoints", "late_setpoints", "Setpoints that had waited here too long, and were dropped."),
    ("opened", "opened", "Times that the link was opened."),
)


def encoder() -> Encoder:
    """Return what writes metrics; loads the library, which takes a tenth of a second."""
    from prometheus_client.exposition import choose_encoder

    def encode(snapshot: Mapping[str, Any], accept: str) -> tuple[bytes, str]:
        write, content_type = choose_encoder(accept)
        return write(_Families(snapshot)), content_type

    return encode


class _Families:
    """What the library calls a collector."""

    def __init__(self, snapshot: Mapping[str, Any]) -> None:
        self._snapshot = snapshot

    def collect(self) -> Iterable[Metric]:
        """Return the metrics of the snapshot."""
        return families(self._snapshot)


def families(status: Mapping[str, Any]) -> Iterator[Metric]:
    """Yield each metric of a snapshot (``companion.status.snapshot``); what is not known is left out."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

    def gauge(name: str, help_text: str, value: float | None) -> Iterator[Metric]:
        if value is not None:
            yield GaugeMetricFamily(_PREFIX + name, help_text, value=value)

    def counter(name: str, help_text: str, label: str, values: Mapping[str, float | None]) -> Metric:
        family = CounterMetricFamily(_PREFIX + name, help_text, labels=[label])
        for key, value in values.items():
            if value is not None:
                family.add_metric([key], value)
        return family

    def gauges(name: str, help_text: str, label: str, values: Mapping[str, float | None]) -> Metric:
        family = GaugeMetricFamily(_PREFIX + name, help_text, labels=[label])
        for key, value in values.items():
            if value is not None:
                family.add_metric([key], value)
        return family

    counts, worker, source, host = status["counts"], status["worker"], status["source"], status["host"]
    yield InfoMetricFamily(
        _PREFIX + "build", "The version that runs.", value={"version": str(status["version"])}
    )
    yield from gauge("uptime_seconds", "Time since the service was started.", status["uptime_s"])

    states = {str(state): float(str(state) == status["state"]) for state in State}
    yield gauges("state", "1 for the state of the switch S, 0 for the others.", "state", states)
    yield from gauge(
        "ready", "1 while every input that protection needs is good.", status["not_ready"] is None
    )
    yield from gauge("engaged", "1 while protection is wanted.", status["engaged"])
    yield from gauge("armed", "1 while the vehicle is armed.", status["armed"])

    yield CounterMetricFamily(_PREFIX + "frames", "Frames taken from the source.", value=counts["frames"])
    yield from gauge("source_up", "1 while the frame source works.", source["fault"] is None)
    yield from gauge(
        "frame_age_seconds", "Time since the newest frame was taken.", _seconds(source["frame_age_ms"])
    )
    yield from gauge(
        "pose_age_seconds", "Age of the newest pose of the autopilot.", _seconds(status["pose_age_ms"])
    )
    yield from gauge(
        "autopilot_heartbeat_age_seconds",
        "Time since the autopilot's newest HEARTBEAT.",
        _seconds(status["autopilot_age_ms"]),
    )
    yield from gauge(
        "clock_round_trip_seconds",
        "Round trip of the best comparison with the autopilot's clock.",
        _seconds(status["clock_round_trip_ms"]),
    )

    yield counter("reports", "Answers of the vision worker.", "kind", counts["detections"])
    yield counter(
        "reports_without_direction",
        "Answers without a direction, by what the detector says.",
        "reason",
        counts["reasons"],
    )
    report = status.get("report", {})
    yield from gauge(
        "report_age_seconds", "Time since the frame of the newest answer.", _seconds(report.get("age_ms"))
    )
    yield from gauge(
        "detection_duration_seconds",
        "Time that the newest answer took in the worker.",
        _seconds(report.get("detector_ms")),
    )
    yield from gauge(
        "worker_up", "1 while the vision worker is ready or busy.", worker["state"] in ("ready", "busy")
    )
    yield CounterMetricFamily(
        _PREFIX + "worker_restarts", "Times that the worker was started again.", value=worker["restarts"]
    )
    yield CounterMetricFamily(
        _PREFIX + "worker_frames_replaced",
        "Frames that a newer one replaced before the worker could take them.",
        value=worker["frames_replaced"],
    )

    yield counter(
        "setpoints", "Setpoints passed on, by what became of them.", "action", _of(counts, _ACTIONS)
    )
    yield counter("setpoints_dropped", "Setpoints that were not passed on.", "reason", counts["dropped"])
    yield counter("setpoints_unprotected", "Setpoints that passed untouched.", "kind", counts["unprotected"])
    yield CounterMetricFamily(
        _PREFIX + "rivalries",
        "Times that several senders fought over the vehicle.",
        value=counts["rivalries"],
    )
    yield CounterMetricFamily(
        _PREFIX + "handler_errors", "Faults of ours that a setpoint met.", value=counts["handler_errors"]
    )

    links = status["links"]
    yield gauges(
        "link_up", "1 while the link is open.", "link", _each(links, lambda link: link["state"] == "open")
    )
    yield gauges(
        "link_peers", "Those that the link sends to.", "link", _each(links, lambda link: link["peers"])
    )
    for key, name, help_text in _LINK_COUNTERS:
        yield counter(f"link_{name}", help_text, "link", {name: link[key] for name, link in links.items()})

    yield from gauge(
        "host_cpu_busy_ratio", "Share of the processors busy since the look before.", host["cpu_load"]
    )
    for name in ("memory", "disk"):
        used, total = host[f"{name}_used_mib"], host[f"{name}_total_mib"]
        yield from gauge(f"host_{name}_used_bytes", f"Used {name}.", used and used * _MIB)
        yield from gauge(f"host_{name}_size_bytes", f"All {name}.", total and total * _MIB)
    yield gauges(
        "host_temperature_celsius",
        "Thermal zones, by the kernel's name.",
        "zone",
        host["temperatures_deg_c"],
    )
    processes = status["processes"]
    yield gauges(
        "process_resident_memory_bytes",
        "Resident memory.",
        "process",
        {name: use["rss_mib"] and use["rss_mib"] * _MIB for name, use in processes.items()},
    )
    yield counter(
        "process_cpu_seconds",
        "Processor time of the process.",
        "process",
        {name: use["cpu_s"] for name, use in processes.items()},
    )


def _seconds(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else milliseconds / 1000


def _of(counts: Mapping[str, Any], names: Iterable[str]) -> dict[str, float | None]:
    return {name: counts[name] for name in names}


def _each(
    links: Mapping[str, Mapping[str, Any]], value: Callable[[Mapping[str, Any]], float]
) -> dict[str, float | None]:
    return {name: float(value(link)) for name, link in links.items()}
