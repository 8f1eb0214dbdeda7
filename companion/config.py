"""The configuration: one frozen model, read strictly from TOML.

Every key has a unit in its name where it has one, a range, a default and an explanation; the commented
default file (``companion config --default``) is generated from here, so that the two cannot disagree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

_LEAST_HORIZON_S = 0.5
"""No autopilot stops sooner after the last velocity."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Two keys, each right by itself, that cannot both hold.

    Attributes
    ----------
    key
        Dotted below the table that was checked.
    found, allowed
        For people.
    """

    key: str
    found: str
    allowed: str


class DisagreementError(ValueError):
    """Carries every disagreement of one table through pydantic's validation."""

    def __init__(self, disagreements: tuple[Disagreement, ...]) -> None:
        super().__init__("; ".join(f"{d.key}: found {d.found}; allowed: {d.allowed}" for d in disagreements))
        self.disagreements = disagreements


def _checked_host_port(address: str) -> str:
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or not 1 <= int(port) <= 65535:
        raise ValueError("HOST:PORT with a port from 1 to 65535")
    return address


def _checked_udp_endpoint(endpoint: str) -> str:
    port = int(endpoint.rpartition(":")[2])
    least = 0 if endpoint.startswith("udpin:") else 1
    if not least <= port <= 65535:
        raise ValueError(f"a port from {least} to 65535" + (" (0: any free one)" if least == 0 else ""))
    return endpoint


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def _disagreements(self) -> tuple[Disagreement, ...]:
        """Return what is wrong between keys that are right one by one."""
        return ()

    @model_validator(mode="after")
    def _check_between_keys(self) -> Self:
        if found := self._disagreements():
            raise DisagreementError(found)
        return self


class SourceConfig(_Section):
    """Where frames come from."""

    kind: Annotated[
        Literal["file", "socket"],
        Field(
            description="file: a video file or a folder of images. socket: raw grey frames over loopback TCP, sent by a simulator or another program."
        ),
    ] = "file"
    path: Annotated[
        str,
        Field(
            description="file: the video, or the folder of images (sorted by name; times from its timestamps.csv, else from fps)."
        ),
    ] = ""
    address: Annotated[
        str,
        AfterValidator(_checked_host_port),
        Field(description="socket: HOST:PORT that sends the frames.", examples=["127.0.0.1:5600"]),
    ] = "127.0.0.1:5600"
    playback: Annotated[
        Literal["recorded", "fastest"], Field(description="file: at recorded speed, or as fast as possible.")
    ] = "recorded"
    loop: Annotated[
        bool,
        Field(description="file: start again at the end. Otherwise the source ends and detection stops."),
    ] = False
    fps: Annotated[
        float, Field(gt=0, le=1000, description="file: frame rate where the recording does not say (Hz).")
    ] = 10.0
    min_rate_hz: Annotated[
        float,
        Field(
            ge=0,
            le=200,
            description="Below this measured frame rate there is no detection, and that is announced. Larger: stricter.",
        ),
    ] = 2.0
    timeout_s: Annotated[
        float,
        Field(gt=0, le=60, description="No frame for this long: the camera counts as dead and is reopened."),
    ] = 1.0


class CameraConfig(_Section):
    """The camera and how it is mounted."""

    hfov_deg: Annotated[
        float,
        Field(
            gt=5,
            lt=170,
            description="Horizontal field of view, used when no calibration file is given (deg).",
        ),
    ] = 70.0
    file: Annotated[
        str, Field(description="Camera file (TOML) with intrinsics and distortion; empty: hfov_deg alone.")
    ] = ""
    mount_roll_deg: Annotated[
        float,
        Field(ge=-180, le=180, description="Rotation of the camera about the body's forward axis (deg)."),
    ] = 0.0
    mount_pitch_deg: Annotated[
        float, Field(ge=-90, le=90, description="Camera tilt; positive looks up (deg).")
    ] = 0.0
    mount_yaw_deg: Annotated[
        float, Field(ge=-180, le=180, description="Camera pan; positive looks to the right (deg).")
    ] = 0.0


class DetectorConfig(_Section):
    """The detector in its worker process."""

    preset: Annotated[
        Literal["default", "paper"],
        Field(description="Parameter set: default (measured best) or paper (literal)."),
    ] = "default"
    params_file: Annotated[
        str,
        Field(
            description="TOML file with detector parameters that replace those of the preset; empty: none."
        ),
    ] = ""
    deadline_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="A pair that takes longer counts as hung: the worker is killed and restarted.",
        ),
    ] = 10.0
    start_timeout_s: Annotated[
        float, Field(gt=0, le=300, description="Time allowed for the worker to start (imports included).")
    ] = 60.0
    restart_delay_s: Annotated[
        float,
        Field(gt=0, le=60, description="First delay before a restart; doubles up to restart_delay_max_s."),
    ] = 0.2
    restart_delay_max_s: Annotated[
        float, Field(gt=0, le=600, description="Longest delay between restarts.")
    ] = 5.0
    vehicle_width_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Width swept along a direction to find its free distance, margins included (m). Larger: fewer ways count as free.",
        ),
    ] = 0.9
    vehicle_height_m: Annotated[
        float,
        Field(gt=0, le=5, description="Height swept likewise, margins included (m)."),
    ] = 0.6
    baseline_m: Annotated[
        float,
        Field(
            ge=0.02,
            le=2,
            description="Distance flown between the two frames of a pair that is aimed at (m); 0.4 to 1.8 times of it is taken. Larger: surer ranges, fewer tracks that survive.",
        ),
    ] = 0.25
    threads: Annotated[
        int,
        Field(
            ge=1, le=64, description="OpenCV and BLAS threads of the worker. Leave one core to the service."
        ),
    ] = 1

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if self.restart_delay_s <= self.restart_delay_max_s:
            return ()
        return (
            Disagreement(
                "restart_delay_s",
                str(self.restart_delay_s),
                f"at most restart_delay_max_s, which is {self.restart_delay_max_s}",
            ),
        )


class LinkConfig(_Section):
    """The two UDP sides of the inline proxy."""

    planner: Annotated[
        str,
        Field(
            pattern=r"^udp(in|out):[^:]+:[0-9]{1,5}$",
            description="Planner and ground-station side. udpin:HOST:PORT listens, udpout:HOST:PORT sends first.",
            examples=["udpin:127.0.0.1:14540", "udpout:192.168.1.20:14550"],
        ),
        AfterValidator(_checked_udp_endpoint),
    ] = "udpin:127.0.0.1:14540"
    autopilot: Annotated[
        str,
        Field(
            pattern=r"^udp(in|out):[^:]+:[0-9]{1,5}$",
            description="Autopilot side, in the same form.",
            examples=["udpin:127.0.0.1:14541", "udpout:127.0.0.1:14580"],
        ),
        AfterValidator(_checked_udp_endpoint),
    ] = "udpin:127.0.0.1:14541"
    component_id: Annotated[
        int, Field(ge=1, le=255, description="Our own component id (191 MAV_COMP_ID_ONBOARD_COMPUTER).")
    ] = 191
    planner_system_id: Annotated[
        int,
        Field(
            ge=0,
            le=255,
            description="System id of the planner. Setpoints of others pass untouched and unprotected, announced. 0: any.",
        ),
    ] = 0
    planner_component_id: Annotated[
        int, Field(ge=0, le=255, description="Component id of the planner, likewise. 0: any.")
    ] = 0
    signing_key_file: Annotated[
        str,
        Field(
            description="Key of MAVLink 2 signing: 32 bytes, or 64 hexadecimal digits, in a file that its owner alone may read. Signed setpoints are verified and signed again, our own messages are signed. Empty: signed setpoints pass untouched and unprotected, with an alarm."
        ),
    ] = ""
    signing_link_id: Annotated[
        int,
        Field(
            ge=0, le=255, description="Our link id in signatures. No other link of the network may use it."
        ),
    ] = 200

    def _disagreements(self) -> tuple[Disagreement, ...]:
        same = self.planner == self.autopilot and not self.planner.endswith(":0")
        if not same:
            return ()
        return (Disagreement("autopilot", f'"{self.autopilot}"', "another endpoint than planner's"),)


class GuidanceConfig(_Section):
    """The switch S: how a planner's setpoint is followed, replaced, turned or held."""

    allow_unprotected: Annotated[
        bool,
        Field(
            description="Not ready (no camera, no worker, no pose): true forwards the planner's setpoints untouched, false holds."
        ),
    ] = False
    max_step_m: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            description="Longest horizontal step from the vehicle to a setpoint sent while protected (m). Larger: faster, longer to stop.",
        ),
    ] = 1.5
    velocity: Annotated[
        Literal["redirect", "hold", "forward"],
        Field(
            description="Setpoints of velocity alone. redirect: flown toward the void, vz and speed kept. hold: no horizontal motion, vz kept. forward: untouched and unprotected, announced."
        ),
    ] = "redirect"
    velocity_horizon_s: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="How far a velocity reaches counts as its step: the speed is at most max_step_m, or the free distance less its margin, in this time (s). It is what the autopilot needs to stop by itself when setpoints end. 0: as measured with its default parameters, PX4 1.5 s (COM_OF_LOSS_T 1.0), ArduPilot 4.1 s (GUID_TIMEOUT 3). Larger: slower.",
        ),
    ] = 0.0
    step_margin_m: Annotated[
        float,
        Field(ge=0, le=5, description="Kept between the end of a step and the nearest thing seen there (m)."),
    ] = 0.8
    agree_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="The void agrees with the planner when it lies within this angle of the bearing (deg). Larger: the planner is followed more often.",
        ),
    ] = 12.0
    agree_hysteresis_deg: Annotated[
        float, Field(ge=0, le=45, description="Extra angle before agreement is lost again (deg).")
    ] = 5.0
    view_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="Half angle about the camera's axis within which a bearing counts as in view (deg).",
        ),
    ] = 25.0
    align_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="No translation while the commanded direction is further than this off the heading (deg).",
        ),
    ] = 20.0
    yaw_rate_deg_s: Annotated[
        float,
        Field(
            gt=0,
            le=180,
            description="Cap of the commanded yaw's rate (deg/s). Autopilots do not all cap it themselves.",
        ),
    ] = 30.0
    commit_distance_m: Annotated[
        float,
        Field(
            gt=0, le=20, description="Distance flown along a void before looking towards the goal again (m)."
        ),
    ] = 1.5
    wall_k: Annotated[
        int,
        Field(
            ge=1, le=20, description="Single-plane answers needed among the last wall_n to call it a wall."
        ),
    ] = 2
    wall_n: Annotated[int, Field(ge=1, le=20, description="Window of answers that wall_k counts in.")] = 3
    wall_limit_m: Annotated[
        float, Field(gt=0, le=50, description="A plane further away than this is not a wall yet (m).")
    ] = 2.0
    wall_margin_m: Annotated[
        float,
        Field(
            ge=0, le=10, description="Added to min(goal, wall_limit_m) when a plane's range is judged (m)."
        ),
    ] = 0.5
    turn_step_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="Yaw step of a turn in front of a wall (deg). At most half the field of view.",
        ),
    ] = 30.0
    probe_step_m: Annotated[
        float,
        Field(
            gt=0,
            le=2,
            description="Step flown to get parallax after a turn (m). Must exceed the detector's baseline.",
        ),
    ] = 0.4
    bootstrap_probe: Annotated[
        bool,
        Field(
            description="Allow one step along the camera's axis per heading where nothing was seen or flown yet."
        ),
    ] = True
    hold_probe_s: Annotated[
        float,
        Field(
            gt=0, le=60, description="HOLD without parallax for this long, planner wants to move: PROBE (s)."
        ),
    ] = 1.0
    arrive_radius_m: Annotated[
        float,
        Field(ge=0, le=10, description="A goal nearer than this, stationary, is flown to directly (m)."),
    ] = 0.6
    goal_settle_s: Annotated[
        float, Field(ge=0, le=60, description="A goal that has not moved for this long is stationary (s).")
    ] = 1.0
    episode_distance_m: Annotated[
        float,
        Field(
            gt=0,
            le=50,
            description="An avoidance episode (side of turn, blocked bearings) ends after this distance (m).",
        ),
    ] = 3.0
    redetect_distance_m: Annotated[
        float, Field(gt=0, le=10, description="An answer is used up after this distance from its frame (m).")
    ] = 1.0
    redetect_yaw_deg: Annotated[
        float,
        Field(gt=0, le=180, description="An answer is used up after this much yaw from its frame (deg)."),
    ] = 25.0
    detection_max_age_s: Annotated[
        float, Field(gt=0, le=60, description="Greatest age of an answer while moving (s).")
    ] = 2.0
    detection_max_age_hover_s: Annotated[
        float, Field(gt=0, le=600, description="Greatest age of an answer at rest (s).")
    ] = 10.0
    moving_m_s: Annotated[
        float, Field(gt=0, le=5, description="Above this speed the vehicle counts as moving (m/s).")
    ] = 0.15
    bad_reports_to_hold: Annotated[
        int,
        Field(
            ge=1,
            le=20,
            description="Reports without an answer in a row (too little texture, blurred, ...; not: no motion) that end the last answer.",
        ),
    ] = 2
    probe_timeout_s: Annotated[
        float, Field(gt=0, le=60, description="A probe that brought no answer in this time has failed (s).")
    ] = 5.0
    report_timeout_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="No report of any kind from the worker for this long: vision counts as dead (s).",
        ),
    ] = 2.0
    pose_max_age_s: Annotated[float, Field(gt=0, le=5, description="Greatest age of the pose (s).")] = 0.5
    planner_timeout_s: Annotated[
        float, Field(gt=0, le=60, description="Silence after which the planner's goal is forgotten (s).")
    ] = 1.0
    estimator_jump_m: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            description="A position jump larger than this beyond what the speed explains is an estimator reset (m).",
        ),
    ] = 1.0
    give_up_s: Annotated[
        float,
        Field(
            gt=0,
            le=3600,
            description="HOLD for this long while the planner wants to move: give up, announced (s).",
        ),
    ] = 60.0
    give_up: Annotated[
        Literal["stay", "autopilot_hold"],
        Field(
            description="On giving up: stay in HOLD, or ask the autopilot once for its own Hold/Brake mode."
        ),
    ] = "stay"

    def _disagreements(self) -> tuple[Disagreement, ...]:
        found: list[Disagreement] = []
        if self.wall_k > self.wall_n:
            found.append(Disagreement("wall_k", str(self.wall_k), f"at most wall_n, which is {self.wall_n}"))
        if 0.0 < self.velocity_horizon_s < _LEAST_HORIZON_S:
            found.append(
                Disagreement(
                    "velocity_horizon_s",
                    str(self.velocity_horizon_s),
                    f"0 (the autopilot's own), or from {_LEAST_HORIZON_S} to 10",
                )
            )
        if self.detection_max_age_s > self.detection_max_age_hover_s:
            found.append(
                Disagreement(
                    "detection_max_age_s",
                    str(self.detection_max_age_s),
                    f"at most detection_max_age_hover_s, which is {self.detection_max_age_hover_s}",
                )
            )
        return tuple(found)


class LogConfig(_Section):
    """Logs."""

    level: Annotated[
        Literal["debug", "info", "warning", "error"], Field(description="Least severity that is logged.")
    ] = "info"
    format: Annotated[
        Literal["auto", "text", "json"],
        Field(description="auto: text on a terminal, JSON otherwise (systemd, files, pipes)."),
    ] = "auto"
    status_interval_s: Annotated[
        float,
        Field(
            ge=0, le=3600, description="A status line with all rates and ages every so often; 0: never (s)."
        ),
    ] = 10.0
    detections: Annotated[bool, Field(description="One line for each detection report.")] = False
    setpoints: Annotated[bool, Field(description="One line for each setpoint decision.")] = False


class Config(_Section):
    """The whole configuration."""

    source: SourceConfig = SourceConfig()
    camera: CameraConfig = CameraConfig()
    detector: DetectorConfig = DetectorConfig()
    link: LinkConfig = LinkConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    log: LogConfig = LogConfig()

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if self.camera.file:  # the field of view is then known only to whoever reads that file
            return ()
        half_view_deg = self.camera.hfov_deg / 2
        return tuple(
            Disagreement(
                f"guidance.{key}",
                str(value_deg),
                f"at most half of camera.hfov_deg, which is {half_view_deg:g}",
            )
            for key, value_deg in (
                ("view_deg", self.guidance.view_deg),
                ("turn_step_deg", self.guidance.turn_step_deg),
            )
            if value_deg > half_view_deg
        )
