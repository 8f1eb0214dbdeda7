"""Parameters of the detector: one frozen model, two presets, overrides from a TOML file.

Pixel figures of the paper belong to its 1280 x 720 images. Fields that end in ``_at_1280`` are given for that
width and scaled with the width of the image (:func:`scaled_px`); the other pixel figures hold at any size.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

REFERENCE_WIDTH_PX = 1280.0
"""Width of the paper's images (section 3)."""

PresetName = Literal["paper", "default"]


class ParamsError(ValueError):
    """Parameters cannot be used: the message names the file, the key, what was found and what is allowed."""


class DetectorParams(BaseModel):
    """All parameters of the detector. The field defaults are those of the ``paper`` preset.

    Section numbers are the paper's. "Notebook" marks settings that the paper leaves out and that come from its
    authors' published notebook.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    # ------------------------------------------------------------------ speed
    speed: Annotated[
        Literal["fast", "exact"],
        Field(
            description="exact: every key point of both frames, scikit-learn's k-means, as printed. fast: the same steps at flight rate, see the fast_ settings."
        ),
    ] = "fast"
    fast_first_points: Annotated[
        int,
        Field(
            ge=50,
            le=100_000,
            description="fast: most locations that the flow starts from in the first loop, which estimates p, n and k. Larger: slower, nearer to exact.",
        ),
    ] = 2000
    fast_points: Annotated[
        int,
        Field(ge=50, le=100_000, description="fast: the same in the other loops."),
    ] = 500
    fast_tiles: Annotated[
        int,
        Field(
            ge=1,
            le=48,
            description="fast: parts (of 48) of each frame that are looked at anew for key points. Larger: slower; new things come in sooner.",
        ),
    ] = 2
    fast_restarts: Annotated[
        int, Field(ge=1, le=100, description="fast: k-means runs for each n in the first loop.")
    ] = 6

    # ------------------------------------------------------------------ frames
    min_width_px: Annotated[
        int, Field(ge=16, le=4096, description="Frames narrower than this are refused (wrong_size).")
    ] = 64
    min_height_px: Annotated[
        int, Field(ge=16, le=4096, description="Frames lower than this are refused (wrong_size).")
    ] = 48
    black_grey: Annotated[
        float,
        Field(
            ge=0,
            le=255,
            description="A frame whose 98th percentile of grey lies below this is black. Larger: stricter.",
        ),
    ] = 24.0
    saturated_grey: Annotated[
        float, Field(ge=128, le=255, description="Grey from which a pixel counts as saturated.")
    ] = 250.0
    saturated_fraction: Annotated[
        float,
        Field(
            gt=0, le=1, description="A frame with more saturated pixels than this is refused. Larger: laxer."
        ),
    ] = 0.5
    blur_limit: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Perceptual blur (0 sharp, 1 blurred) above which a frame is refused (section 4: unblurred frames). Larger: laxer; 1 never refuses.",
        ),
    ] = 0.72

    # ------------------------------------------------------------------ 2.1 features
    sift_octave_layers: Annotated[
        int,
        Field(ge=1, le=8, description="Layers an octave of the SIFT detector (section 2.1; notebook: 3)."),
    ] = 3
    sift_contrast: Annotated[
        float,
        Field(ge=0, le=1, description="SIFT contrast threshold (section 2.1; OpenCV's 0.04). Larger: fewer."),
    ] = 0.04
    unique_locations: Annotated[
        bool,
        Field(
            description="Use a location once where SIFT gives it several orientations. The paper counts key points, so false there."
        ),
    ] = False
    min_features: Annotated[
        int, Field(ge=3, le=100_000, description="Key points needed in either frame (section 2.1: 100).")
    ] = 100

    # ------------------------------------------------------------------ 2.2 optical flow
    lk_window_px: Annotated[
        int, Field(ge=3, le=101, description="Side of the Lucas-Kanade window, odd (2.2; notebook: 15).")
    ] = 15
    lk_levels: Annotated[
        int, Field(ge=0, le=10, description="Pyramid levels above the base (2.2; notebook: 5).")
    ] = 5
    lk_iterations: Annotated[
        int, Field(ge=1, le=1000, description="Most iterations of Lucas-Kanade (2.2; notebook: 10).")
    ] = 10
    lk_epsilon_px: Annotated[
        float, Field(gt=0, le=1, description="Lucas-Kanade stops at a step below this (2.2; notebook: 0.03).")
    ] = 0.03
    lk_predict_rotation: Annotated[
        bool,
        Field(
            description="Start Lucas-Kanade where a known rotation alone would put the point. Not in the paper, which has no rotation."
        ),
    ] = False
    round_trip_px: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="Distribution filter: start and return differ by less than this on each axis (2.2: 0.5; notebook: 0.05).",
        ),
    ] = 0.5
    shortest_fraction: Annotated[
        float, Field(ge=0, lt=1, description="Length filter: share of shortest vectors dropped (2.2: 0.1).")
    ] = 0.1
    angle_statistics: Annotated[
        Literal["linear", "circular"],
        Field(
            description="Angular filter: mean and deviation of the angle on the line [0, 360) as printed (2.2), or on the circle."
        ),
    ] = "linear"
    angle_gain: Annotated[
        float,
        Field(
            gt=0,
            lt=1,
            description="p is the first of 2..9 whose widening gains less than this share of survivors (2.2: 0.10; notebook: 0.05).",
        ),
    ] = 0.10
    min_flow_vectors: Annotated[
        int,
        Field(
            ge=3,
            le=100_000,
            description="Flow vectors needed after all filters; fewer is too_little_flow (notebook: 100).",
        ),
    ] = 100

    # ------------------------------------------------------------------ motion
    still_flow_px_at_1280: Annotated[
        float,
        Field(
            ge=0,
            le=100,
            description="Median flow, rotation taken out, below which the camera did not move (no_motion). Not in the paper. Larger: more is called no motion.",
        ),
    ] = 2.5
    still_flow_floor_px: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="The limit above never falls below this: noise of Lucas-Kanade at any size.",
        ),
    ] = 0.4
    rotation_check: Annotated[
        bool,
        Field(
            description="Also fit a pure rotation to the flow: what leaves no parallax behind is no_motion. Not in the paper."
        ),
    ] = False
    parallax_px_at_1280: Annotated[
        float,
        Field(
            ge=0,
            le=100,
            description="80th percentile of the flow left by the rotation fit, below which there is no parallax.",
        ),
    ] = 2.4

    # ------------------------------------------------------------------ 2.2 clusters
    clusters_min: Annotated[
        int, Field(ge=2, le=100, description="Least n tried (2.2: 1, for which the indices are undefined).")
    ] = 2
    clusters_max: Annotated[int, Field(ge=2, le=100, description="Greatest n tried (2.2: 15).")] = 15
    kmeans_restarts: Annotated[
        int, Field(ge=1, le=100, description="k-means runs from different centres; the best is kept (2.2).")
    ] = 4
    kmeans_iterations: Annotated[
        int, Field(ge=1, le=10_000, description="Most iterations of one k-means run (2.2).")
    ] = 300
    seed: Annotated[
        int,
        Field(
            ge=0, le=2**32 - 1, description="Seed of the k-means starts. Same input, same seed: same answer."
        ),
    ] = 0
    nearest_step: Annotated[
        int, Field(ge=1, le=1000, description="k = step * i nearest neighbours (2.2: k = 5 i).")
    ] = 5
    nearest_steps: Annotated[int, Field(ge=1, le=100, description="i runs to this (2.2: 8).")] = 8
    nearest_change: Annotated[
        float,
        Field(
            gt=0,
            lt=1,
            description="The first k whose estimates moved by less than this against the one before (2.2: 0.05; notebook: 0.10).",
        ),
    ] = 0.05

    # ------------------------------------------------------------------ 2.2 single plane
    plane_test: Annotated[
        Literal["deviation_px", "deviation_ratio", "plane_share"],
        Field(
            description="deviation_px: standard deviation of the centre magnitudes in px, as printed (2.2). deviation_ratio: that over their median, free of scale. plane_share: the share of the flow vectors that one plane explains, where the focus of expansion is known, else deviation_ratio."
        ),
    ] = "deviation_px"
    plane_deviation_px_at_1280: Annotated[
        float,
        Field(
            ge=0,
            le=1000,
            description="deviation_px: below this it is one plane. The printed 500 is math.degrees(8.73 px) (2.2; notebook).",
        ),
    ] = 8.73
    plane_ratio: Annotated[
        float,
        Field(gt=0, le=10, description="deviation_ratio: below this it is one plane. Larger: more planes."),
    ] = 0.30
    plane_share: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="plane_share: from this share on it is one plane. Larger: fewer planes. Not in the paper.",
        ),
    ] = 0.9
    depth_cue: Annotated[
        Literal["flow", "inverse_contact"],
        Field(
            description="What a centre's magnitude is: the length of the flow, as printed (2.2), or, where the focus of expansion is known, flow over distance from it, which is 1 / time to contact."
        ),
    ] = "flow"

    # ------------------------------------------------------------------ 2.3 vanishing points
    edge_low: Annotated[
        float,
        Field(gt=0, le=10, description="Lower Canny threshold over the median grey (2.3; notebook: 0.67)."),
    ] = 0.67
    edge_high: Annotated[
        float,
        Field(gt=0, le=10, description="Upper Canny threshold over the median grey (2.3; notebook: 1.33)."),
    ] = 1.33
    hough_votes_at_1280: Annotated[
        float, Field(ge=1, le=10_000, description="Votes that a line needs (2.3; notebook: 100).")
    ] = 100.0
    hough_min_length_px_at_1280: Annotated[
        float, Field(ge=1, le=1280, description="Least length of a line (2.3; notebook: 50).")
    ] = 50.0
    hough_max_gap_px_at_1280: Annotated[
        float, Field(ge=0, le=1280, description="Largest gap in a line (2.3; notebook: 10).")
    ] = 10.0
    lines_wanted: Annotated[
        int,
        Field(
            ge=0,
            le=1000,
            description="Adapt the votes until about this many lines pass the gate (section 3: about 10, tuned by hand there); 0 keeps the votes fixed.",
        ),
    ] = 0
    line_angle_min_deg: Annotated[
        float,
        Field(ge=0, lt=180, description="Lines with a greater angle to the horizontal count (2.3: 40)."),
    ] = 40.0
    line_angle_max_deg: Annotated[
        float,
        Field(gt=0, le=180, description="Lines with a smaller angle to the horizontal count (2.3: 140)."),
    ] = 140.0
    vertical_gap_deg: Annotated[
        float,
        Field(
            ge=0,
            lt=90,
            description="Drop lines this near to vertical (notebook: 10); 0 keeps them, as printed.",
        ),
    ] = 0.0
    pair_angle_min_deg: Annotated[
        float,
        Field(ge=0, lt=90, description="Two lines intersect from this difference of angle on (2.3: 5)."),
    ] = 5.0
    pair_angle_max_deg: Annotated[
        float, Field(gt=0, le=90, description="... and up to this one (2.3: 15).")
    ] = 15.0
    cell_px: Annotated[
        float,
        Field(
            ge=1,
            le=200,
            description="Side of a cell of the intersection histogram, at any image size (2.3, eq. 1: 10).",
        ),
    ] = 10.0

    # ------------------------------------------------------------------ 2.4 vote
    vote_tolerance: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="A vanishing point is elected when |L_VP - L_LMCC| is below this share of L_LMCC (2.4: 0.05).",
        ),
    ] = 0.05

    # ------------------------------------------------------------------ time to contact
    contact_gate_px_at_1280: Annotated[
        float,
        Field(
            gt=0,
            le=1280,
            description="Half width of the band about a direction whose tracks give its time to contact. Not in the paper.",
        ),
    ] = 100.0

    @model_validator(mode="after")
    def _ordered(self) -> DetectorParams:
        if self.lk_window_px % 2 == 0:
            raise ValueError(f"lk_window_px must be odd, found {self.lk_window_px}")
        for low, high in (
            ("clusters_min", "clusters_max"),
            ("edge_low", "edge_high"),
            ("line_angle_min_deg", "line_angle_max_deg"),
            ("pair_angle_min_deg", "pair_angle_max_deg"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(
                    f"{low} ({getattr(self, low)}) must not exceed {high} ({getattr(self, high)})"
                )
        return self

    @classmethod
    def preset(cls, name: PresetName, **overrides: Any) -> DetectorParams:
        """Return a preset, with single fields replaced.

        Parameters
        ----------
        name
            ``paper``: faithful, literal thresholds scaled by width. ``default``: measured best (docs/presets.md).
        overrides
            Field values that replace those of the preset.

        Raises
        ------
        ParamsError
            For an unknown preset or a field that cannot be used.
        """
        if name not in _PRESETS:
            raise ParamsError(f"preset: found {name!r}, allowed are {', '.join(sorted(_PRESETS))}")
        return validated(cls, {**_PRESETS[name], **overrides}, source=f"preset {name}")

    @classmethod
    def from_toml(cls, path: Path, preset: PresetName = "default") -> DetectorParams:
        """Return a preset with the fields that a TOML file gives replaced.

        Raises
        ------
        ParamsError
            The file cannot be read or parsed, or a key is unknown, of the wrong type or out of range.
        """
        overrides = read_toml(path)
        if preset not in _PRESETS:
            raise ParamsError(f"preset: found {preset!r}, allowed are {', '.join(sorted(_PRESETS))}")
        return validated(cls, {**_PRESETS[preset], **overrides}, source=str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """Return what a TOML file of parameters holds.

    Raises
    ------
    ParamsError
        The file cannot be read or parsed.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParamsError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ParamsError(f"{path}: is not UTF-8 text") from error
    except tomllib.TOMLDecodeError as error:
        raise ParamsError(f"{path}: is not valid TOML: {error}") from error


_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    # Why each of these: docs/presets.md.
    "default": {
        "sift_contrast": 0.013,
        "min_features": 60,
        "min_flow_vectors": 60,
        "unique_locations": True,
        "lk_predict_rotation": True,
        "rotation_check": True,
        "plane_test": "plane_share",
        "lines_wanted": 10,
    },
}


def scaled_px(value_at_1280: float, width_px: int) -> float:
    """Return a pixel figure given for a width of 1280 at the width of this image."""
    return value_at_1280 * width_px / REFERENCE_WIDTH_PX


Params = TypeVar("Params", bound=BaseModel)


def validated(model: type[Params], values: Mapping[str, Any], source: str) -> Params:
    """Return a method's parameters from what a file or a person gave.

    Parameters
    ----------
    model
        :class:`DetectorParams`, or those of another method.
    values
        By field; the others have their defaults.
    source
        What the message names.

    Raises
    ------
    ParamsError
        A key is unknown, of the wrong type or out of range; one line each.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        lines = [_explain(model, source, item) for item in error.errors()]
        raise ParamsError("\n".join(lines)) from error


def _explain(model: type[BaseModel], source: str, item: Any) -> str:
    key = ".".join(str(part) for part in item["loc"]) or "parameters"
    if item["type"] == "extra_forbidden":
        allowed = ", ".join(sorted(model.model_fields))
        return f"{source}: {key}: unknown key (found {item['input']!r}); allowed are {allowed}"
    message = item["msg"].removeprefix("Value error, ")
    if not item["loc"]:
        return f"{source}: {message}"
    return f"{source}: {key}: found {item['input']!r}, allowed: {message[0].lower()}{message[1:]}"
