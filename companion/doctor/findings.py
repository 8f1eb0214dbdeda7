"""What an examination observed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.host_status import HostStatus
from companion.mavlink.telemetry import Heartbeat
from companion.mavlink.timesync import ClockSync


@dataclass(frozen=True, slots=True)
class LinkFinding:
    """One endpoint.

    Attributes
    ----------
    name, url
        As the configuration has them.
    state
        ``open``, or why not.
    received_bytes, frames, crc_errors, garbage_bytes
        What came in while it was listened to.
    """

    name: str
    url: str
    state: str
    received_bytes: int = 0
    frames: int = 0
    crc_errors: int = 0
    garbage_bytes: int = 0


@dataclass(frozen=True, slots=True)
class CameraFinding:
    """The frame source.

    Attributes
    ----------
    fault
        Why it does not deliver; "" where it does.
    rate_hz
        Frames a second.
    width_px, height_px
        Of the last frame.
    model_fault
        Why the vision worker does not take camera and detector settings; "" where it does, None where it was not tried.
    """

    fault: str
    rate_hz: float = 0.0
    width_px: int = 0
    height_px: int = 0
    model_fault: str | None = None


@dataclass(frozen=True, slots=True)
class Findings:
    """All of an examination.

    Attributes
    ----------
    links
        Both sides.
    vehicle
        The autopilot's HEARTBEAT; None: there was none.
    autopilot_systems
        System ids of all autopilots that were heard.
    rates_hz
        Of the vehicle's messages, by id, over the second half: what did not come was asked for before.
    version
        (major, minor, patch) of the autopilot; None: it did not tell.
    parameters
        Of the autopilot, those asked for that it answered.
    clock
        What its clock is against ours.
    estimator_flags
        As in ESTIMATOR_STATUS or EKF_STATUS_REPORT.
    planners
        (system, component) of those on the planner's side, and whether they send setpoints.
    signing_fault
        Why the signing key cannot be used; "" where it can or none is configured.
    camera, host
        The rest.
    """

    links: tuple[LinkFinding, ...]
    vehicle: Heartbeat | None
    autopilot_systems: frozenset[int]
    rates_hz: Mapping[int, float]
    version: tuple[int, int, int] | None
    parameters: Mapping[str, float]
    clock: ClockSync | None
    estimator_flags: int | None
    planners: Mapping[tuple[int, int], bool]
    signing_fault: str
    camera: CameraFinding
    host: HostStatus
