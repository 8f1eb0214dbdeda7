"""What a detection can be: a direction, a single plane, or no detection with its reason.

Both methods answer with these. What only one of them knows (confidence, uncertainty of the focus of expansion) is None for the other.

A failed estimate is a value with a reason, never None and never an exception.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum


class DirectionKind(StrEnum):
    """Where a direction came from: of the paper's method (section 2.4), or a gap of the void map."""

    VANISHING_POINT = "vanishing_point"
    """The vanishing-point candidate nearest to the LMCC was elected."""
    LOWEST_FLOW = "lowest_flow"
    """No candidate was elected: the lowest-magnitude cluster centre itself (LMCC)."""
    GAP = "gap"
    """A gap of the void map that the vehicle fits through (method ``parallax``)."""


class NoDetectionReason(StrEnum):
    """Why there is no answer. The words are stable: they appear in logs, STATUSTEXT and JSON."""

    TOO_FEW_FEATURES_EARLIER = "too_few_features_earlier"
    """Fewer SIFT key points than the limit in the first frame (paper section 2.1: 100)."""
    TOO_FEW_FEATURES_LATER = "too_few_features_later"
    """Fewer SIFT key points than the limit in the second frame."""
    TOO_LITTLE_FLOW = "too_little_flow"
    """Too few optical flow vectors left by the filters of section 2.2."""
    TOO_LITTLE_TEXTURE = "too_little_texture"
    """Too few places in the picture whose flow could be measured (method ``parallax``)."""
    NOTHING_KNOWN = "nothing_known"
    """There was flow, but in no direction enough of it to say how far the way is free (method ``parallax``)."""
    NO_MOTION = "no_motion"
    """The camera did not move far enough for parallax. Never a wall, and not a failure."""
    BLURRED = "blurred"
    BLACK = "black"
    SATURATED = "saturated"
    WRONG_SIZE = "wrong_size"
    """The frame's size is not the earlier frame's, not the camera model's, or too small."""
    NO_EARLIER_FRAME = "no_earlier_frame"
    """The observer holds no earlier frame to pair with this one yet."""


@dataclass(frozen=True, slots=True)
class TimeToContact:
    """Time to contact, in units of the pair's interval (frames of the pair).

    Multiplied with the metres flown between the two frames it is a distance along the motion.

    Attributes
    ----------
    frames
        Steps of the pair's length until contact with what was seen there.
    spread_frames
        Robust standard deviation of the samples' values, same unit.
    samples
        Number of optical flow vectors behind it.
    """

    frames: float
    spread_frames: float
    samples: int


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """How the camera moved between the two frames, as far as the method found it out (method ``parallax``).

    Attributes
    ----------
    rotation_source
        ``attitude`` (given, not refined), ``attitude_refined`` or ``flow``.
    intrinsics_source
        ``calibration``, ``field_of_view``, ``estimated`` (from the flow of earlier pairs) or ``assumed``.
    direction_later
        Unit vector from the earlier to the later position, in the later camera's axes.
    direction_sigma_deg, rotation_sigma_deg
        Standard deviations, of the less certain axis.
    focus_px, focus_sigma_px
        Focus of expansion in the later frame without distortion; None where the camera did not move forwards.
    samples, informative
        Samples of the flow, and those that say something of their range.
    plane_preferred, plane_share, plane_normal_later
        Whether one plane explains the flow better than a scene with depth, the share of samples that it explains, and its unit normal.
    parallax_rad
        Flow that the best rotation leaves, 80th percentile.
    intrinsics_detail
        How sure an estimate of the intrinsics is, or why there is none; else "".
    """

    rotation_source: str
    intrinsics_source: str
    direction_later: tuple[float, float, float]
    direction_sigma_deg: float
    rotation_sigma_deg: float
    focus_px: tuple[float, float] | None
    focus_sigma_px: float | None
    samples: int
    informative: int
    plane_preferred: bool
    plane_share: float
    plane_normal_later: tuple[float, float, float] | None
    parallax_rad: float
    intrinsics_detail: str = ""


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """How an answer came about. Points are (x, y) in px of the second frame's full size.

    Attributes
    ----------
    n_features_earlier, n_features_later
        SIFT key points in either frame.
    n_tracks, n_after_distribution, n_after_length, n_after_angle
        N, N', N'', N''' of paper section 2.2.
    p, n, k
        The angular filter's factor, the number of clusters, the number of nearest neighbours.
    centre_points_px, centre_magnitudes_px
        The cluster centres and the mean flow of their k nearest vectors.
    lmcc_px, lmcc_magnitude_px
        Lowest-magnitude cluster centre.
    lines_px
        Segments (x1, y1, x2, y2) that the gate on beta let through.
    n_lines
        Segments found before that gate.
    candidates_px
        Vanishing-point candidates, at most one a cluster.
    plane_statistic, plane_threshold
        What the single-plane test compared (px in the literal test, a ratio in the scale-free one).
    focus_of_expansion_px
        From the pose's translation or the derotated flow, where it is known.
    motion
        Of the parallax method.
    seconds
        Wall time of each step.
    """

    n_features_earlier: int = 0
    n_features_later: int = 0
    n_tracks: int = 0
    n_after_distribution: int = 0
    n_after_length: int = 0
    n_after_angle: int = 0
    p: int | None = None
    n: int | None = None
    k: int | None = None
    centre_points_px: tuple[tuple[float, float], ...] = ()
    centre_magnitudes_px: tuple[float, ...] = ()
    lmcc_px: tuple[float, float] | None = None
    lmcc_magnitude_px: float | None = None
    n_lines: int = 0
    lines_px: tuple[tuple[float, float, float, float], ...] = ()
    candidates_px: tuple[tuple[float, float], ...] = ()
    plane_statistic: float | None = None
    plane_threshold: float | None = None
    median_flow_px: float | None = None
    focus_of_expansion_px: tuple[float, float] | None = None
    motion: MotionEstimate | None = None
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Direction:
    """The furthest empty plane lies at (x_px, y_px) of the second frame: (x_d, y_d) of the paper.

    ``confidence`` in [0, 1] is how often answers like it are right; None from a method that does not say.
    """

    x_px: float
    y_px: float
    kind: DirectionKind
    time_to_contact: TimeToContact | None
    diagnostics: Diagnostics
    confidence: float | None = None


@dataclass(frozen=True, slots=True)
class SinglePlane:
    """One plane (a wall) fills the view: turn about z (paper section 2.2). ``confidence`` as of a :class:`Direction`."""

    time_to_contact: TimeToContact | None
    diagnostics: Diagnostics
    confidence: float | None = None


@dataclass(frozen=True, slots=True)
class NoDetection:
    """No answer, and why. ``detail`` holds the figures behind the reason, for people."""

    reason: NoDetectionReason
    detail: str
    diagnostics: Diagnostics


Detection = Direction | SinglePlane | NoDetection
