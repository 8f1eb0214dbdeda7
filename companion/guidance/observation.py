"""What the decisions are made from: poses and detection reports, each with the time when it was true."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pose:
    """The vehicle at one time.

    Attributes
    ----------
    time_ns
        Our monotonic time at which it was true.
    north_m, east_m, down_m
        Position of the body in local NED.
    q_ned_from_body
        Unit quaternion (w, x, y, z), body FRD to local NED.
    """

    time_ns: int
    north_m: float
    east_m: float
    down_m: float
    q_ned_from_body: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class BearingRange:
    """Free distance measured along one azimuth from where the frame was taken.

    Attributes
    ----------
    azimuth_rad
        Local NED, 0 = north, clockwise, in (-pi, pi].
    distance_m
        Distance to the nearest thing seen within the vehicle's width around that azimuth.
    spread_m
        Its robust standard deviation.
    samples
        Optical flow vectors behind it.
    """

    azimuth_rad: float
    distance_m: float
    spread_m: float
    samples: int


@dataclass(frozen=True, slots=True)
class DetectionReport:
    """One answer of the vision worker. A missing report is never replaced by an older one.

    Attributes
    ----------
    frame_seq, frame_ns
        The second frame of the pair: its number and when it was exposed (our monotonic time).
    kind
        ``vanishing_point``, ``lowest_flow`` (the paper's method), ``gap`` (of the void map, method ``parallax``), ``single_plane`` or ``none``.
    reason
        The detector's reason where kind is ``none``, else "".
    detail
        Figures behind the reason, for people.
    x_px, y_px
        The direction in the image, where there is one.
    ray_body
        The direction as a unit vector in body FRD, where there is one and the camera is known.
    pose
        The pose the detector was given for this frame, if any.
    baseline_m
        Metres flown between the two frames of the pair, where poses are known.
    time_to_contact_frames
        Steps of the pair's length until contact with what was seen there; None when not known.
    time_to_contact_s, time_to_contact_spread_s
        The same in seconds, at the pair's own mean speed, and its standard deviation.
    distance_m, distance_spread_m
        Metric time to contact along the direction, or to the plane; None when not known.
    bearings
        Free distance by azimuth, as far as this frame saw it. An azimuth that is not listed is unknown, and unknown is not free.
    remembered
        Free distance by azimuth out of this frame's view, from frames before it (method ``parallax``).
    confidence
        In [0, 1]: how often answers like it are right. None where the method does not say.
    obstacles
        Places at the vehicle's height where something was surely seen nearby: north and east in local NED, m.
    earlier_frame_ns
        When the first frame of the pair was exposed, where there was one and it is known.
    swept_m
        How far the vehicle's whole width can be moved from the frame's pose through what was looked through (method ``parallax``), along azimuths evenly spaced from north
        clockwise, m; no more than some 2 m, which stands for "at least so far". Empty: the method does not say.
    detector_s
        Seconds that the detector took.
    """

    frame_seq: int
    frame_ns: int
    kind: str
    reason: str = ""
    detail: str = ""
    x_px: float | None = None
    y_px: float | None = None
    ray_body: tuple[float, float, float] | None = None
    pose: Pose | None = None
    baseline_m: float | None = None
    time_to_contact_frames: float | None = None
    time_to_contact_s: float | None = None
    time_to_contact_spread_s: float | None = None
    distance_m: float | None = None
    distance_spread_m: float | None = None
    bearings: tuple[BearingRange, ...] = ()
    remembered: tuple[BearingRange, ...] = ()
    confidence: float | None = None
    obstacles: tuple[tuple[float, float], ...] = ()
    earlier_frame_ns: int | None = None
    swept_m: tuple[float, ...] = ()
    detector_s: float = 0.0
