"""Where MAVLink, vision and the switch S meet: the proxy asks for verdicts here, the worker reports here."""

from __future__ import annotations

import math
from typing import Any, Final

from companion.config import Config
from companion.frames.source import Frame
from companion.guidance.coordinates import heading_rad, quaternion_from_euler
from companion.guidance.dialect import Ambiguous, Autopilot, Motion, NotUnderstood, Reading, understand
from companion.guidance.engagement import Inputs
from companion.guidance.geodesy import Anchor, GlobalReference
from companion.guidance.observation import DetectionReport, Pose
from companion.guidance.pose_buffer import PoseBuffer
from companion.guidance.setpoint import (
    Decision,
    Drop,
    Forward,
    Rewrite,
    Setpoint,
    Unprotected,
    Verdict,
)
from companion.guidance.substitution import GaveUp, State, StateChanged, Switch
from companion.guidance.wish import express, wish_of
from companion.io.feed import Feed
from companion.io.messages import Kind
from companion.log import Log
from companion.log_fields import report_fields, verdict_fields
from companion.mavlink.identity import Identity, MavSeverity, MavState
from companion.mavlink.obstacle_distance import obstacle_distance
from companion.mavlink.requests import EngageRequest
from companion.mavlink.sources import Source
from companion.mavlink.telemetry import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_PX4,
    Attitude,
    AttitudeQuaternion,
    CurrentMode,
    ExtendedSysState,
    GlobalOrigin,
    GlobalPosition,
    Heartbeat,
    LocalPosition,
    Odometry,
    Telemetry,
    Unusable,
    VehicleMode,
    is_offboard,
    vehicle_mode,
)
from companion.mavlink.timesync import ClockSync
from companion.run_statistics import RunStatistics

_HEARTBEAT_LOST_NS: Final = 3_500_000_000
_ESTIMATOR_KEPT_NS: Final = 5_000_000_000
_MOST_REFUSALS: Final = 32
"""Senders of forged setpoints that are announced: their ids are the forger's choice."""
_NEVER_NS: Final = -(1 << 62)
_AUTOPILOTS: Final = {
    MAV_AUTOPILOT_PX4: Autopilot.PX4,
    MAV_AUTOPILOT_ARDUPILOTMEGA: Autopilot.ARDUPILOT,
}
_REQUEST_COUNTS_NS: Final = 1_500_000_000
"""By then a HEARTBEAT (1 Hz) has said whether a request was carried out."""


class Interception:
    """Feeds the switch S with what the autopilot and the worker say, and gives its verdicts to the proxy.

    It implements ``mavlink.proxy.ProxyHandler``; every call returns at once.

    Parameters
    ----------
    config
        The whole configuration.
    identity
        Our own component, which announces changes.
    log
        Takes the events.
    feed
        Told of poses, setpoints and states.
    """

    def __init__(self, config: Config, *, identity: Identity, log: Log, feed: Feed | None = None) -> None:
        guidance = config.guidance
        self.switch = Switch(
            guidance,
            camera_yaw_rad=math.radians(config.camera.mount_yaw_deg),
            vehicle_width_m=config.detector.vehicle_width_m,
        )
        self.statistics = RunStatistics()
        self._config = config
        self._identity = identity
        self._log = log
        self.feed = feed if feed is not None else Feed()
        self._poses = PoseBuffer(jump_m=guidance.estimator_jump_m)
        self._reference = GlobalReference()
        self._announced_unprotected: set[str] = set()
        self._announced_refused: set[str] = set()
        self._unusable: set[tuple[int, str]] = set()
        self._reset_counter: int | None = None
        self._autopilot_heartbeat_ns: int | None = None
        self._heartbeat_lost = False
        self._mode = VehicleMode(armed=False, offboard=False)
        self._asked_to_arm_ns = _NEVER_NS
        self._asked_for_offboard_ns = _NEVER_NS
        self._was_ready = False
        self._off: str | None = None
        self._clock_refused = False
        self._watches_mission = False
        self._faults: dict[str, str] = {}
        self._estimator: tuple[int, int] | None = None
        self._report_waiting: DetectionReport | None = None
        self._last_report: DetectionReport | None = None
        self._last_verdict: dict[str, Any] = {}
        self._last_places: dict[str, tuple[float, float] | None] = {}

    # ------------------------------------------------------------------ from the proxy

    def on_setpoint(self, setpoint: Setpoint, system_id: int, component_id: int, now_ns: int) -> Verdict:
        """Return what is sent in place of a planner's setpoint of position or velocity."""
        if not self._is_planner(system_id, component_id):
            return Unprotected(f"from {system_id}/{component_id}, not the planner")
        return self.treat(setpoint, system_id, component_id, now_ns)

    def treat(self, setpoint: Setpoint, system_id: int, component_id: int, now_ns: int) -> Verdict:
        """Return what is sent in place of a setpoint of whomever, the mission's goal included."""
        reading = understand(setpoint, self._autopilot())
        match reading:
            case NotUnderstood():
                return Unprotected(reading.reason)
            case Ambiguous():
                return Drop("autopilot not known")
            case Reading(motion=Motion.VELOCITY) if self._config.guidance.velocity == "forward":
                return Unprotected("velocity only")
        verdict = self._decide(setpoint, reading, now_ns)
        self.statistics.setpoints.tick(now_ns)
        self.announce()
        if self._report_waiting is not None and self.switch.state is not State.DISENGAGED:
            waited_ms = (now_ns - self._report_waiting.frame_ns) / 1e6
            self.statistics.frame_to_setpoint_ms.append(waited_ms)
            self._report_waiting = None
        self._last_verdict = verdict_fields(setpoint, verdict)
        if self.feed.wants(Kind.SETPOINT):
            fields = {"planner": f"{system_id}/{component_id}", "state": str(self.switch.state)}
            self.feed.setpoint({**fields, **self._last_places, **self._last_verdict}, now_ns)
        if self._config.log.setpoints:
            self._log.info(
                "setpoint",
                state=str(self.switch.state),
                planner=f"{system_id}/{component_id}",
                **self._last_verdict,
            )
        return verdict

    def _decide(self, setpoint: Setpoint, reading: Reading, now_ns: int) -> Verdict:
        """Ask the switch S in local NED, and say its answer in the setpoint's own kind."""
        anchor, autopilot, guidance = self._reference.anchor, self._autopilot(), self._config.guidance
        wish = wish_of(
            setpoint, reading, pose=self.switch.pose, anchor=anchor, autopilot=autopilot, config=guidance
        )
        decision = self.switch.on_setpoint(wish, now_ns)
        self._last_places = {"goal_ned": wish.goal, "decided_ned": _place_of(decision, wish.goal)}
        return express(
            decision,
            setpoint,
            reading,
            pose=self.switch.pose if self.switch.pose_is_fresh(now_ns) else None,
            anchor=anchor,
            autopilot=autopilot,
            config=guidance,
        )

    def _is_planner(self, system_id: int, component_id: int) -> bool:
        link = self._config.link
        return link.planner_system_id in (0, system_id) and link.planner_component_id in (0, component_id)

    def _autopilot(self) -> Autopilot:
        vehicle = self._identity.vehicle
        if vehicle is None:
            return Autopilot.UNKNOWN
        return _AUTOPILOTS.get(vehicle.autopilot, Autopilot.OTHER)

    def on_rivals(self, sources: tuple[Source, ...], now_ns: int) -> None:
        """Announce that several senders fight over the vehicle: the autopilot takes from each in turn."""
        names = [f"{system_id}/{component_id}" for system_id, component_id in sources]
        self._log.warning("rival_setpoints", sources=names, time_ns=now_ns)
        self._identity.status_text(MavSeverity.WARNING, f"void: setpoints from {' and '.join(names)}")

    def on_refused_signature(self, source: Source, reason: str) -> None:
        """Announce, once for each sender and reason, that a signed setpoint was dropped."""
        sender = f"{source[0]}/{source[1]}"
        key = f"{sender}: {reason}"
        if key in self._announced_refused or len(self._announced_refused) >= _MOST_REFUSALS:
            return
        self._announced_refused.add(key)
        self._log.error("setpoint_signature_refused", sender=sender, reason=reason)
        self._identity.status_text(MavSeverity.ERROR, f"void: setpoint of {sender} dropped, {reason}")

    def on_unprotected(self, kind: str, detail: str) -> None:
        """Announce, once for each kind, that a setpoint passes through as it came."""
        key = f"{kind}: {detail}"
        if key in self._announced_unprotected:
            return
        self._announced_unprotected.add(key)
        self._log.warning("setpoint_unprotected", kind=kind, detail=detail)
        self._identity.status_text(MavSeverity.WARNING, f"void: UNPROTECTED {kind} {detail}")

    def on_engage_request(self, request: EngageRequest, now_ns: int) -> None:
        """Protect from the moment that OFFBOARD or arming is asked for: the HEARTBEAT says so up to a second later.

        A request that is refused holds setpoints for a second and a half that the vehicle does not follow anyway.
        """
        if request.arm:
            self._asked_to_arm_ns = now_ns
        if request.offboard:
            self._asked_for_offboard_ns = now_ns
        self._tell_mode(now_ns)

    def on_telemetry(self, message: Telemetry | Unusable, now_ns: int) -> None:
        """Take one message of the autopilot's telemetry."""
        match message:
            case LocalPosition():
                reset = self._poses.add_position(
                    message.time_boot_ms,
                    now_ns,
                    (message.x, message.y, message.z),
                    (message.vx, message.vy, message.vz),
                )
                if reset:
                    self._on_estimator_reset(now_ns, "position jump")
                self._reference.on_local(message.time_boot_ms, message.x, message.y, message.vx, message.vy)
                self._tell_pose()
            case GlobalPosition():
                self._reference.on_global(message.time_boot_ms, message.lat_int, message.lon_int)
            case GlobalOrigin():
                self._reference.on_origin(message.lat_int, message.lon_int)
            case Attitude():
                q = quaternion_from_euler(message.roll, message.pitch, message.yaw)
                rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
                if self._poses.add_attitude(message.time_boot_ms, now_ns, q, rates):
                    self._on_estimator_reset(now_ns, "autopilot restarted")
            case AttitudeQuaternion():
                rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
                if self._poses.add_attitude(message.time_boot_ms, now_ns, message.q_ned_from_body, rates):
                    self._on_estimator_reset(now_ns, "autopilot restarted")
            case Odometry():
                if self._reset_counter not in (None, message.reset_counter):
                    self._poses.clear()
                    self._on_estimator_reset(now_ns, "reset counter")
                self._reset_counter = message.reset_counter
            case Heartbeat():
                self._on_heartbeat(message, now_ns)
            case CurrentMode():
                self._on_current_mode(message, now_ns)
            case Unusable():
                if (message.message_id, message.reason) not in self._unusable:
                    self._unusable.add((message.message_id, message.reason))
                    self._log.warning(
                        "telemetry_unusable", message_id=message.message_id, reason=message.reason
                    )
            case ExtendedSysState():
                pass

    def _on_heartbeat(self, heartbeat: Heartbeat, now_ns: int) -> None:
        if not self._identity.learn(heartbeat):
            return
        self._autopilot_heartbeat_ns = now_ns
        self._mode = vehicle_mode(heartbeat)
        self._tell_mode(now_ns)

    def _on_current_mode(self, message: CurrentMode, now_ns: int) -> None:
        """Take the mode from the faster message: a switch on the remote control is then known at once."""
        vehicle = self._identity.vehicle
        if vehicle is None:  # what the number means depends on the kind of autopilot
            return
        self._mode = self._mode._replace(offboard=is_offboard(vehicle, message.custom_mode))
        self._tell_mode(now_ns)

    def _tell_mode(self, now_ns: int) -> None:
        """Tell the mode that the autopilot last named, ahead of it what was just asked for.

        A request counts until the autopilot has carried it out: what it says after that is the pilot's doing.
        """
        if self._mode.armed:
            self._asked_to_arm_ns = _NEVER_NS
        if self._mode.offboard:
            self._asked_for_offboard_ns = _NEVER_NS
        armed = self._mode.armed or now_ns - self._asked_to_arm_ns <= _REQUEST_COUNTS_NS
        offboard = (
            self._mode.offboard
            or self._watches_mission
            or now_ns - self._asked_for_offboard_ns <= _REQUEST_COUNTS_NS
        )
        self.switch.on_vehicle(armed=armed, offboard=offboard, now_ns=now_ns, off=self._off)
        self.announce()

    def _on_estimator_reset(self, now_ns: int, why: str) -> None:
        self._log.warning("estimator_reset", why=why)
        self._reference.forget()
        self.switch.on_estimator_reset(now_ns, why)
        self.announce()

    def _tell_pose(self) -> None:
        pose = self._poses.newest()
        speed_m_s = self._poses.speed_m_s()
        if pose is not None and speed_m_s is not None:
            self.switch.on_pose(pose, speed_m_s)
            self.feed.pose(pose, speed_m_s)

    def autopilot_age_ms(self, now_ns: int) -> int | None:
        """Return the age of the autopilot's newest HEARTBEAT; None before the first."""
        seen = self._autopilot_heartbeat_ns
        return None if seen is None else round((now_ns - seen) / 1e6)

    # ------------------------------------------------------------------ from our own component

    @property
    def armed(self) -> bool:
        """Whether the autopilot last said that the vehicle is armed."""
        return self._mode.armed

    def set_config(self, config: Config) -> None:
        """Take other settings from the next setpoint on; those of links, camera and worker act after a restart."""
        self._config = config
        self.switch.set_limits(config.guidance)

    def set_off(self, off: str | None, now_ns: int) -> None:
        """Take why protection is not wanted; None: it is."""
        self._off = off
        if self._autopilot_heartbeat_ns is not None:  # before, an unknown mode is held
            self._tell_mode(now_ns)

    @property
    def reference(self) -> Anchor | None:
        """Where local NED lies on the globe, where that is known."""
        return self._reference.anchor

    def watch_mission(self, on: bool, now_ns: int) -> None:
        """Judge the way of the autopilot's own mission too, although no setpoint is followed there."""
        if on != self._watches_mission:
            self._watches_mission = on
            self._tell_mode(now_ns)

    def on_estimator(self, flags: int, now_ns: int) -> None:
        """Take ESTIMATOR_STATUS.flags, or those of EKF_STATUS_REPORT."""
        self._estimator = (flags, now_ns)

    def on_clock(self, sync: ClockSync, now_ns: int) -> None:
        """Take what the autopilot's clock is against ours: poses are then as old as they are."""
        is_used = self._poses.synchronise(sync.offset_ns, now_ns)
        if not is_used and self.switch.pose is not None and not self._clock_refused:
            self._clock_refused = True
            self._log.warning("clock_refused", offset_ns=sync.offset_ns, round_trip_ns=sync.round_trip_ns)

    def inputs(self, now_ns: int) -> Inputs:
        """Return what is known of everything that protection needs."""
        seen, switch, camera = self._autopilot_heartbeat_ns, self.switch, self._config.camera
        pose = "no pose from the autopilot" if switch.pose is None else "pose too old"
        estimator = self._estimator
        is_told = estimator is not None and now_ns - estimator[1] <= _ESTIMATOR_KEPT_NS
        return Inputs(
            heartbeat_ok=seen is not None and now_ns - seen <= _HEARTBEAT_LOST_NS,
            pose=None if switch.pose_is_fresh(now_ns) else pose,
            estimator_flags=estimator[0] if estimator is not None and is_told else None,
            frames=self._faults.get("camera"),
            worker=self._faults.get("worker"),
            camera_model=bool(camera.file) or "hfov_deg" in camera.model_fields_set,
        )

    # ------------------------------------------------------------------ from camera and worker

    def pose_of(self, frame: Frame, now_ns: int) -> Pose | None:
        """Count a frame and return the vehicle's pose at the time of its exposure, where it is known."""
        self.statistics.frames_total += 1
        self.statistics.frames.tick(now_ns)
        return self._poses.at(frame.time_ns)

    def on_report(self, report: DetectionReport, now_ns: int) -> None:
        """Take one report of the vision worker."""
        statistics = self.statistics
        statistics.reports.tick(now_ns)
        statistics.detections[report.kind] += 1
        if report.kind == "none":
            statistics.reasons[report.reason] += 1
        statistics.detection_ms.append(1e3 * report.detector_s)
        self._last_report = report
        self._report_waiting = report
        self.switch.on_report(report, now_ns)
        if self._config.detector.send_obstacle_distance:
            distances = obstacle_distance(report, self.switch.pose)
            if distances is not None:
                self._identity.send(distances)
        if self._config.log.detections:
            self._log.info("detection", **report_fields(report, now_ns))

    def set_fault(self, name: str, reason: str | None, now_ns: int) -> None:
        """Tell the switch S of a failing input, or that it works again."""
        if reason is None:
            self._faults.pop(name, None)
        else:
            self._faults[name] = reason
        self.switch.set_fault(name, reason, now_ns)

    # ------------------------------------------------------------------ to the outside

    def check_links(self, now_ns: int) -> None:
        """Announce that the autopilot's heartbeat was lost or is back."""
        seen = self._autopilot_heartbeat_ns
        lost = seen is not None and now_ns - seen > _HEARTBEAT_LOST_NS
        if lost != self._heartbeat_lost:
            self._heartbeat_lost = lost
            # The mode stays what it was: protection is not dropped because a heartbeat is missing.
            if lost:
                self._log.warning("autopilot_heartbeat_lost")
            else:
                self._log.info("autopilot_heartbeat_back")

    def mav_state(self, now_ns: int) -> MavState:
        """Return what our HEARTBEAT says: BOOT until all inputs were good once, then ACTIVE, STANDBY or CRITICAL.

        STANDBY: all is good, and nobody wants protection.
        """
        if self.switch.not_ready(now_ns) is None and not self._heartbeat_lost:
            self._was_ready = True
            return MavState.ACTIVE if self._off is None else MavState.STANDBY
        return MavState.CRITICAL if self._was_ready else MavState.BOOT

    def announce(self) -> None:
        """Log and send what the switch S has to say."""
        for event in self.switch.drain_events():
            match event:
                case StateChanged():
                    self._log.info(
                        "state",
                        previous=str(event.previous),
                        state=str(event.state),
                        reason=event.reason,
                        time_ns=event.time_ns,
                    )
                    self.feed.state(str(event.previous), str(event.state), event.reason, event.time_ns)
                    self._identity.status_text(_severity(event), f"void: {event.state} {event.reason}")
                case GaveUp():
                    self._log.error("gave_up", reason=event.reason, ask_autopilot=event.ask_autopilot)
                    self._identity.status_text(MavSeverity.CRITICAL, f"void: gave up, {event.reason}")
                    if event.ask_autopilot:
                        asked = self._identity.request_hold()
                        self._log.warning("autopilot_hold_requested", sent=asked)

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return the state, rates and ages of now, for the status line."""
        pose = self._poses.newest()
        statistics = self.statistics
        fields: dict[str, Any] = {
            "state": str(self.switch.state),
            "reason": self.switch.reason,
            "not_ready": self.switch.not_ready(now_ns),
            "frames_hz": round(statistics.frames.rate_hz(now_ns), 1),
            "reports_hz": round(statistics.reports.rate_hz(now_ns), 1),
            "setpoints_hz": round(statistics.setpoints.rate_hz(now_ns), 1),
            "pose_age_ms": None if pose is None else round((now_ns - pose.time_ns) / 1e6),
        }
        if pose is not None:
            fields["pose"] = [round(v, 3) for v in (pose.north_m, pose.east_m, pose.down_m)]
            fields["heading_deg"] = round(math.degrees(heading_rad(pose.q_ned_from_body)), 1)
        if self._last_report is not None:
            fields["report"] = report_fields(self._last_report, now_ns)
        if self._last_verdict:
            fields["setpoint"] = self._last_verdict
        return fields


def _severity(event: StateChanged) -> MavSeverity:
    return MavSeverity.WARNING if event.state is State.HOLD else MavSeverity.INFO


def _place_of(decision: Decision, goal: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return north and east (m, local NED) of where a decision sends the vehicle; None where it says no place."""
    if isinstance(decision, Rewrite):
        return decision.x, decision.y
    return goal if isinstance(decision, Forward) else None
