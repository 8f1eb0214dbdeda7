"""Parameters of the parallax method: one frozen model.

Pixel figures hold in the working image, which is reduced to about ``width_px`` where the camera's is larger.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class ParallaxParams(BaseModel):
    """All parameters of flow, egomotion, plane and ranges. Those of the void map are its own."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    # ------------------------------------------------------------------ flow
    width_px: Annotated[
        int,
        Field(
            ge=80,
            le=4096,
            description="Images are reduced to about this width. Larger: finer, slower (half of it cost 15 points of right directions).",
        ),
    ] = 640
    step_px: Annotated[
        int, Field(ge=2, le=64, description="Of the sample grid. Larger: fewer samples, faster.")
    ] = 8
    round_trip_px: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="There and back must end within this, where the picture fixes the flow. Larger: laxer.",
        ),
    ] = 0.7
    unlike_share: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="The two ends of a flow vector may differ by this share of the picture's contrast there. Larger: more wrong matches on even texture pass. At 0.6 a third of the wrong ones do not, and one in thirty of the right ones.",
        ),
    ] = 0.6
    flow_sigma_px: Annotated[
        float,
        Field(gt=0, le=5, description="Noise of the flow of a well textured sample, one axis."),
    ] = 0.3
    grey_sigma: Annotated[
        float,
        Field(
            gt=0,
            le=50,
            description="Noise of grey values between the frames. Larger: more texture is needed for a sample to count.",
        ),
    ] = 3.0
    noise_factor: Annotated[
        float,
        Field(
            ge=0,
            le=5,
            description="How many times the gradients of the picture's own noise are taken off its texture. Larger: more texture is needed.",
        ),
    ] = 1.5
    loose_sigma_px: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            description="Noise of the flow in a direction that the picture does not fix (along an edge, on a plain surface).",
        ),
    ] = 4.0
    informative_sigma_px: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="A sample says something of its range where its flow along the epipolar line is known this well. Larger: weaker texture counts.",
        ),
    ] = 0.8
    least_informative: Annotated[
        int,
        Field(
            ge=10,
            le=10_000,
            description="Fewer samples with texture than this are too little texture.",
        ),
    ] = 80

    # ------------------------------------------------------------------ first look and sweep of planes
    coarse_width_px: Annotated[
        int,
        Field(
            ge=80,
            le=4096,
            description="Where a pose says which way the camera went, the first look at the motion is taken at about this width. Larger: surer, slower.",
        ),
    ] = 320
    sweep_planes: Annotated[
        int,
        Field(
            ge=2,
            le=256,
            description="Planes that are tried, from infinity to the nearest. Larger: finer, slower.",
        ),
    ] = 48
    sweep_nearest: Annotated[
        float,
        Field(
            gt=0,
            lt=0.95,
            description="Share of its distance from the focus that a place on the nearest plane moved by; 0.6 is two thirds of a baseline away. Larger: nearer things are found, the planes lie wider apart.",
        ),
    ] = 0.6
    swept_margin: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="A swept depth counts where its plane fits by this much (of the local contrast) better than others. Larger: fewer, surer.",
        ),
    ] = 0.75
    swept_sigma: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Standard deviation of a swept inverse depth, 1/baseline. Larger: it tells less of what is far.",
        ),
    ] = 0.01

    # ------------------------------------------------------------------ rotation and direction of travel
    attitude_sigma_deg: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            description="How far a given rotation may be wrong, an axis, one standard deviation. Larger: the flow decides more.",
        ),
    ] = 0.2
    velocity_sigma_deg: Annotated[
        float,
        Field(gt=0, le=60, description="The same of a given direction of travel."),
    ] = 7.0
    cauchy_px: Annotated[
        float,
        Field(
            gt=0, le=10, description="Residuals beyond this lose their weight. Larger: outliers pull more."
        ),
    ] = 0.7
    most_samples: Annotated[
        int, Field(ge=100, le=100_000, description="Samples used for the motion. Larger: slower.")
    ] = 1500
    correlated_samples: Annotated[
        float,
        Field(
            ge=1,
            le=1000,
            description="Neighbouring samples share their windows, and lens and shutter bend the flow of whole regions: so many count as one where the motion is weighed against its priors. Larger: priors count more.",
        ),
    ] = 60.0
    still_rad: Annotated[
        float,
        Field(
            gt=0,
            le=0.1,
            description="Flow that the best rotation alone leaves, 80th percentile; below it there was no motion. A standing camera has up to 0.0006, a moving one 0.0055 or more.",
        ),
    ] = 0.0015

    # ------------------------------------------------------------------ planes
    plane_share: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Share of the samples that one plane must explain, beside the model choice (GRIC). Larger: stricter.",
        ),
    ] = 0.85
    wall_limit_m: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            description="Nothing free beyond this: a wall ahead, whatever its shape. Larger: more walls.",
        ),
    ] = 3.0

    # ------------------------------------------------------------------ scale
    least_baseline_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="A given motion of at least this counts: then no parallax means far away, and not standing still.",
        ),
    ] = 0.05
    assumed_baseline_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Where the baseline is not known, the vehicle's size is swept as if it were this. Larger: narrower ways count as free.",
        ),
    ] = 0.2

    # ------------------------------------------------------------------ without calibration
    assumed_hfov_deg: Annotated[
        float,
        Field(
            gt=20, lt=150, description="Horizontal field of view where neither it nor a calibration is known."
        ),
    ] = 70.0
    focal_pairs: Annotated[
        int,
        Field(ge=1, le=200, description="Pairs that the focal length is estimated from; the newest ones."),
    ] = 15
    focal_least_pairs: Annotated[
        int, Field(ge=1, le=200, description="With fewer pairs it is not estimated. Larger: later, surer.")
    ] = 8
    focal_most_sigma: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="An estimate less sure than this share of itself is refused. Larger: laxer.",
        ),
    ] = 0.12
