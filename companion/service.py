"""The composition root: one TaskGroup of named loops, and what they share.

=============  =========  ==============================================================================
loop           rate       does
=============  =========  ==============================================================================
frames         camera     takes the newest frame, looks up the pose at its time, offers both to vision
vision         events     owns the worker process: start, deadline, restart (``vision.supervisor``)
health         10 Hz      judges inputs, tells the switch S of failures, announces changes of state
heartbeat      1 Hz       our HEARTBEAT, only while health has run
component      10 Hz      our own component: answers that wait, TIMESYNC, plots, the computer's status
takeover       20 Hz      flies where the mission's way is not free (``interception.mode = "takeover"`` only)
settings       events     writes what a ground station has set to its file
status         config     one line with all rates and ages
status-socket  events     answers ``companion status`` and commands, where there is a place for its socket
metrics        events     answers Prometheus, where that is switched on
reload         events     reads the configuration again when asked, or when a file of it has changed
io             50 Hz      owns the I/O process of recorder and live page: start, restart, what it is told; where one is on
systemd        1 Hz       feeds its watchdog, only while health has run; where it started us
=============  =========  ==============================================================================

A planner's setpoints have no loop: they are decided and sent in the call that received them (``mavlink.proxy``).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

from companion.clock import Clock, RealClock
from companion.config import Config
from companion.config_sources import ConfigPlaces
from companion.core import Core
from companion.errors import SourceError
from companion.frames.camera import CameraSource
from companion.frames.file import FileSource
from companion.frames.open import open_source
from companion.frames.source import FrameSource
from companion.guidance.observation import DetectionReport
from companion.interception import Interception
from companion.io.desk import ServiceDesk
from companion.io.feed import Feed
from companion.io.messages import Kind
from companion.io.sinks import RECORDER, sinks_of, wanted_from_the_start
from companion.io.supervisor import IoSupervisor
from companion.io.taps import LatchedClock, LogTap, TappedLink
from companion.log import LevelGate, Log
from companion.mavlink.endpoint import Endpoint, Link
from companion.mavlink.endpoints import make_side
from companion.mavlink.identity import Identity
from companion.mavlink.proxy import InlineProxy
from companion.mavlink.signing import open_signatures
from companion.own import Own
from companion.reload import Reload
from companion.status.http import MetricsServer
from companion.status.machine import Machine
from companion.status.server import Command, StatusServer
from companion.status.snapshot import Section, Snapshots
from companion.status.unix_socket import socket_path
from companion.systemd import ServiceNotifier
from companion.vision.pipeline import VOID_PIPELINE
from companion.vision.supervisor import VisionSupervisor

_HEALTH_PERIOD_NS: Final = 100_000_000
_FEED_STATUS_NS: Final = 500_000_000
_COMPONENT_PERIOD_NS: Final = 100_000_000
_HEARTBEAT_PERIOD_NS: Final = 1_000_000_000
_HEALTH_LATE_NS: Final = 1_000_000_000
"""Health that has not run for this long means that this process does not work: no HEARTBEAT then."""
_RATE_BACK: Final = 1.2
"""A frame rate that fell below the floor counts as back at this multiple of it: one at the floor must not flap."""
_LATE_SETPOINT_S: Final = 0.4
"""Setpoints that waited longer for this process are dropped. Planners send several in that time, and the newest passes."""
_REOPEN_DELAYS_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)


class Service:
    """The companion service, from open sockets to a clean end.

    Parameters
    ----------
    config
        The whole configuration.
    clock
        Where time comes from.
    log
        Takes the events.
    open_frames
        Makes the frame source; by default the one that the configuration names. A simulator gives its own.
    notifier
        Whom to tell that the service works; by default nobody.
    places
        Where the configuration is read again from; by default it holds for the whole run.
    gate
        What is logged, where a reload may change that.
    runtime_folder
        Where the status socket is made when the configuration names no place for it; None: nowhere.
    feed
        Told what happens, for a caller that listens itself; by default the I/O process listens, where one is on.
    log_tap
        What ``log`` was opened with, so that its lines are told too.

    Attributes
    ----------
    commands
        What may be asked for at the status socket besides the status, by name.
    sections
        Further parts of the status, by name.
    """

    def __init__(
        self,
        config: Config,
        *,
        clock: Clock,
        log: Log,
        open_frames: Callable[[], FrameSource] | None = None,
        notifier: ServiceNotifier | None = None,
        places: ConfigPlaces | None = None,
        gate: LevelGate | None = None,
        runtime_folder: Path | None = None,
        feed: Feed | None = None,
        log_tap: LogTap | None = None,
        pipeline: str = VOID_PIPELINE,
    ) -> None:
        self._pipeline = pipeline
        self._is_listened_to = feed is not None or bool(sinks_of(config))
        self._feed = feed if feed is not None else Feed()
        if feed is None:
            self._feed.want(wanted_from_the_start(config))
        self._feed_status: Callable[[int], None] = lambda _: None
        self._feed_status_ns = 0
        self._desk: ServiceDesk | None = None
        self._io: IoSupervisor | None = None
        if log_tap is not None:
            log_tap.take = lambda event: self._feed.log(event, clock.now_ns())
        self.commands: dict[str, Command] = {}
        self.sections: dict[str, Section] = {}
        self._runtime_folder = runtime_folder
        self._config = config
        self._clock = clock
        self._log = log
        self._open_frames = open_frames or partial(open_source, config.source, clock=clock, log=log)
        self._links: tuple[Endpoint, ...] = ()
        self._stop = asyncio.Event()
        self._places = places
        self._gate = gate
        self._reload: Reload | None = None
        self._notifier = notifier if notifier is not None else ServiceNotifier(None)
        self._health_ns = clock.now_ns()
        self._health_has_run = False
        self._last_frame_ns: int | None = None
        self._source_fault: str | None = "no frame yet"
        self._camera: CameraSource | None = None
        self._too_slow = False
        self._report_failure = ""

    @property
    def links(self) -> tuple[Endpoint, ...]:
        """The links of both sides while it runs, the planner's first; empty before."""
        return self._links

    def stop(self) -> None:
        """End the service; :meth:`run` returns soon after."""
        self._stop.set()

    def reload(self) -> None:
        """Read the configuration again and take what may change in flight; soon after, and announced."""
        if self._reload is not None:
            self._reload.request()

    async def run(self) -> None:
        """Run until :meth:`stop`.

        Raises
        ------
        companion.errors.CompanionError
            When a port, the source or the worker's configuration cannot be used at the start.
        """
        config, clock, log = self._config, self._clock, self._log
        async with AsyncExitStack() as stack:
            # The kernel stamps arrivals by real time; to a simulated clock they say nothing.
            make = partial(
                make_side,
                now_ns=clock.now_ns,
                late_after_s=_LATE_SETPOINT_S if isinstance(clock, RealClock) else None,
            )
            planner = make("planner", config.link.planner_urls)
            autopilot = make("autopilot", config.link.autopilot_urls)
            for link in (*planner, *autopilot):
                link.on_state = self._on_link_state
                await stack.enter_async_context(link)
            self._links = (*planner, *autopilot)
            signatures = open_signatures(config.link)
            planner_links, autopilot_links, now_ns = self._tapped(planner, autopilot)
            began_ns = clock.now_ns()
            self._feed.config(config, began_ns)
            core = Core.build(
                config,
                planner_links,
                autopilot_links,
                now_ns=now_ns,
                began_ns=began_ns,
                signatures=signatures,
                apply=self._apply,
                feed=self._feed,
                log=log,
            )
            identity, flight, own, proxy = core.identity, core.flight, core.own, core.proxy

            def on_report(report: DetectionReport) -> None:
                self._take_report(flight, report)

            vision = VisionSupervisor(
                config.detector,
                config.camera,
                clock=clock,
                on_report=on_report,
                log=log,
                pipeline=self._pipeline,
                on_details=lambda details: self._feed.details(details.fields, details.data, clock.now_ns()),
                wants_details=lambda: self._feed.wants(Kind.DETAILS),
            )
            loops: dict[str, Coroutine[Any, Any, None]] = {
                "frames": self._frames(flight, vision),
                "vision": vision.run(),
                "health": self._health(flight, vision),
                "heartbeat": self._heartbeat(flight, identity),
                "component": self._component(own),
                "settings": own.settings.keep(own.complain),
                "status": self._status(flight, vision, proxy, own),
            }
            if self._places is not None:
                self._reload = Reload(
                    self._places,
                    config,
                    settings=own.settings,
                    vision=vision,
                    notifier=self._notifier,
                    say=identity.status_text,
                    gate=self._gate,
                    clock=clock,
                    log=log,
                )
                loops["reload"] = self._reload.run()
            loops.update(self._status_loops(flight, own, proxy, vision))
            loops.update(self._io_loops(identity))
            self._feed_status = partial(self._tell_feed, flight, vision, proxy, own)
            if core.takeover is not None:
                loops["takeover"] = core.takeover.run(clock)
            if self._notifier.enabled:
                loops["systemd"] = self._tell_systemd(flight)
            log.info(
                "service_started",
                planner=_labels(planner),
                autopilot=_labels(autopilot),
                source=config.source.shown_url,
                preset=config.detector.preset,
            )
            try:
                async with asyncio.TaskGroup() as group:
                    tasks = [group.create_task(loop, name=name) for name, loop in loops.items()]
                    await self._stop.wait()
                    self._notifier.stopping()
                    for task in tasks:
                        task.cancel()
            finally:
                log.info("summary", **flight.statistics.summary(), **proxy.counters.as_dict())
                log.info("service_stopped")

    def _status_loops(
        self, flight: Interception, own: Own, proxy: InlineProxy, vision: VisionSupervisor
    ) -> dict[str, Coroutine[Any, Any, None]]:
        """Return the loops that tell other programs on this computer how the service is."""
        config, clock, log = self._config, self._clock, self._log
        path, port = socket_path(config.status, self._runtime_folder), config.status.metrics_port
        loops: dict[str, Coroutine[Any, Any, None]] = {}
        if path is None and not port:
            return loops
        kept = config.ground_station.parameters_file
        snapshots = Snapshots(
            flight=flight,
            own=own,
            proxy=proxy,
            vision=vision,
            links=self._links,
            source=lambda: (
                self._config.source.shown_url,
                self._with_reason(self._source_fault),
                self._last_frame_ns,
            ),
            machine=Machine(Path(kept).parent if kept else Path(), clock=clock),
            processes=lambda: {
                "worker": vision.status.pid,
                "io": None if self._io is None else self._io.pid,
            },
            sections=self.sections,
            clock=clock,
            log=log,
        )
        if path is not None:
            server = StatusServer(path, snapshot=snapshots.take, commands=self.commands, log=log)
            loops["status-socket"] = server.run()
        if port:
            metrics = MetricsServer(config.status.metrics_host, port, snapshot=snapshots.take, log=log)
            loops["metrics"] = metrics.run()
        return loops

    def _tapped(
        self, planner: Sequence[Endpoint], autopilot: Sequence[Endpoint]
    ) -> tuple[Sequence[Link], Sequence[Link], Callable[[], int]]:
        """Return the links as the proxy uses them, and its clock; where somebody may listen, the feed hears them."""
        clock = self._clock
        if not self._is_listened_to:
            return planner, autopilot, clock.now_ns
        latched = LatchedClock(clock.now_ns)
        links = [
            TappedLink(link, number, self._feed, latched)
            for number, link in enumerate((*planner, *autopilot))
        ]
        return links[: len(planner)], links[len(planner) :], latched.now_ns

    def _io_loops(self, identity: Identity) -> dict[str, Coroutine[Any, Any, None]]:
        """Return the loop that owns the I/O process, where the configuration asks for one."""
        sinks = sinks_of(self._config)
        desk = self._desk = ServiceDesk(
            self._feed,
            identity,
            now_ns=self._clock.now_ns,
            has_recorder=RECORDER in sinks,
            apply_settings=None if self._reload is None else self._reload.apply,
        )
        self.commands["record"] = desk.record
        if not sinks:
            return {}
        if RECORDER in sinks:
            self.sections["recorder"] = desk.recorder_status
        self._io = IoSupervisor(
            self._feed,
            sinks,
            self._config,
            handlers=desk.handlers,
            now_ns=self._clock.now_ns,
            log=self._log,
        )
        return {"io": self._io.run()}

    def _apply(self, config: Config) -> None:
        """Take settings that were changed in flight."""
        self._config = config
        self._feed.config(config, self._clock.now_ns())
        if self._io is not None:
            self._io.set_config(config)

    def _take_report(self, flight: Interception, report: DetectionReport) -> None:
        """Hand on a report. What fails there must not end the process in flight: to the switch S vision is silent."""
        now_ns = self._clock.now_ns()
        self._feed.detection(report, now_ns)
        try:
            flight.on_report(report, now_ns)
        except Exception as error:  # noqa: BLE001  whatever fails there, setpoints must go on being decided
            if repr(error) != self._report_failure:  # once, not at the rate of the frames
                self._report_failure = repr(error)
                self._log.exception("report_failed", frame_seq=report.frame_seq)

    def _on_link_state(self, link: Endpoint) -> None:
        self._feed.link(link.name, link.label, link.state, self._clock.now_ns())
        if link.state.startswith("waiting"):
            self._log.warning("link_state", link=link.name, url=link.label, state=link.state)
        else:
            self._log.info("link_state", link=link.name, url=link.label, state=link.state)

    # ------------------------------------------------------------------ loops

    async def _frames(self, flight: Interception, vision: VisionSupervisor) -> None:
        """Take frames for ever: a source that fails or ends is a fault, and is opened again where it can come back."""
        clock, log, config = self._clock, self._log, self._config.source
        failures = 0
        while True:
            try:
                source = self._open_frames()
                self._camera = source if isinstance(source, CameraSource) else None
                async with source:
                    log.info("source_opened", kind=config.scheme)
                    if config.scheme == "file":
                        await vision.wait_ready()  # so that nothing of a recording is lost
                    async for frame in source.frames():
                        now_ns = clock.now_ns()
                        if self._last_frame_ns is None and isinstance(source, FileSource):
                            log.info("source_started", started_ns=source.started_ns)
                        self._last_frame_ns = now_ns
                        self._source_fault = None
                        failures = 0
                        vision.offer(frame, flight.pose_of(frame, now_ns))
                        self._feed.frame(frame, now_ns)
                        del frame  # it may be the driver's memory: not kept while the next one is waited for
                self._source_fault = "frame source has ended"
                log.warning("source_ended")
                if config.scheme == "file":
                    return
            except SourceError as error:
                if self._last_frame_ns is None:
                    raise  # a file that is not there, or what is not installed; cameras come back by themselves
                self._source_fault = "frame source failed"
                log.warning("source_failed", error=str(error))
            delay_s = _REOPEN_DELAYS_S[min(failures, len(_REOPEN_DELAYS_S) - 1)]
            failures += 1
            await clock.sleep_until_ns(clock.now_ns() + int(delay_s * 1e9))

    async def _health(self, flight: Interception, vision: VisionSupervisor) -> None:
        """Judge every input ten times a second."""
        clock = self._clock
        started_ns = clock.now_ns()
        while True:
            now_ns = clock.now_ns()
            config = self._config  # may change in flight
            camera = self._with_reason(self._source_fault)
            if camera is None and self._last_frame_ns is not None:
                floor_hz = config.source.min_rate_hz * (_RATE_BACK if self._too_slow else 1.0)
                slow = flight.statistics.frames.rate_hz(now_ns) < floor_hz
                self._too_slow = slow and now_ns - started_ns > 3e9
                if now_ns - self._last_frame_ns > config.source.timeout_s * 1e9:
                    camera = self._with_reason("no frames from the camera")
                elif self._too_slow:
                    camera = "frame rate below the floor"
            status = vision.status
            worker = None if status.state in ("ready", "busy") else f"vision worker {status.state}"
            self._feed.loop("health", now_ns, {"camera": camera, "worker": worker})
            flight.set_fault("camera", camera, now_ns)
            flight.set_fault("worker", worker, now_ns)
            flight.check_links(now_ns)
            flight.announce()
            self._feed_status(now_ns)
            self._health_ns = now_ns
            self._health_has_run = True
            await clock.sleep_until_ns(now_ns + _HEALTH_PERIOD_NS)

    def _with_reason(self, fault: str | None) -> str | None:
        """Return a fault of the source with what the camera itself says of it."""
        reason = self._camera.fault if self._camera is not None else ""
        return f"{fault}: {reason}" if fault and reason else fault

    async def _heartbeat(self, flight: Interception, identity: Identity) -> None:
        """Send our HEARTBEAT, fed by the loops that it speaks for."""
        while True:
            now_ns = self._clock.now_ns()
            if now_ns - self._health_ns <= _HEALTH_LATE_NS:
                self._feed.loop("heartbeat", now_ns, {})
                identity.heartbeat(flight.mav_state(now_ns))
            await self._clock.sleep_until_ns(now_ns + _HEARTBEAT_PERIOD_NS)

    async def _tell_systemd(self, flight: Interception) -> None:
        """Tell systemd that the service is ready and that it works, fed by the loops that it speaks for."""
        notifier, ready = self._notifier, False
        while True:
            now_ns = self._clock.now_ns()
            if self._health_has_run and now_ns - self._health_ns <= _HEALTH_LATE_NS:
                if not ready:
                    notifier.ready()
                    ready = True
                status = flight.status(now_ns)
                notifier.working(f"{status['state']}: {status['reason']}; frames {status['frames_hz']}/s")
            await self._clock.sleep_until_ns(now_ns + notifier.period_ns)

    async def _component(self, own: Own) -> None:
        """Let our own component send what is due."""
        while True:
            now_ns = self._clock.now_ns()
            self._feed.loop("component", now_ns, {})
            own.component.tick(now_ns)
            await self._clock.sleep_until_ns(now_ns + _COMPONENT_PERIOD_NS)

    def _tell_feed(
        self, flight: Interception, vision: VisionSupervisor, proxy: InlineProxy, own: Own, now_ns: int
    ) -> None:
        """Tell who listens how the service is."""
        if self._desk is not None:
            self._desk.note_armed(flight.armed, now_ns)
        if self._feed.wants(Kind.STATUS) and now_ns >= self._feed_status_ns:
            self._feed_status_ns = now_ns + _FEED_STATUS_NS
            self._feed.status(self._status_fields(flight, vision, proxy, own, now_ns), now_ns)

    def _status_fields(
        self, flight: Interception, vision: VisionSupervisor, proxy: InlineProxy, own: Own, now_ns: int
    ) -> dict[str, Any]:
        return {
            **flight.status(now_ns),
            **own.status(now_ns),
            "armed": flight.armed,
            "worker": vision.status.state,
            "worker_restarts": vision.status.restarts,
            "links": {link.name: link.status() for link in self._links},
            **proxy.counters.as_dict(),
        }

    async def _status(
        self, flight: Interception, vision: VisionSupervisor, proxy: InlineProxy, own: Own
    ) -> None:
        """Write the status line."""
        interval_s = self._config.log.status_interval_s
        if interval_s == 0:
            return
        while True:
            await self._clock.sleep_until_ns(self._clock.now_ns() + int(interval_s * 1e9))
            now_ns = self._clock.now_ns()
            self._log.info("status", **self._status_fields(flight, vision, proxy, own, now_ns))


def _labels(links: Sequence[Endpoint]) -> str:
    return ", ".join(link.label for link in links)
