"""``[guidance]``: the switch S."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.section import Disagreement, Section

_LEAST_HORIZON_S = 0.5
"""No autopilot stops sooner after the last velocity."""


class GuidanceConfig(Section):
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
        Field(
            ge=0,
            le=5,
            description="Kept between the end of a step and the nearest thing seen there. Larger: stops further from walls; too large: passes no door (m).",
        ),
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
        float,
        Field(
            ge=0,
            le=45,
            description="Extra angle before agreement is lost again. Larger: changes less often between following the planner and steering (deg).",
        ),
    ] = 5.0
    view_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="Half angle about the camera's axis within which a bearing counts as in view. Larger: flies further to the side of where it looks (deg).",
        ),
    ] = 25.0
    align_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="No translation while the commanded direction is further than this off the heading. Larger: begins to fly while still turning (deg).",
        ),
    ] = 20.0
    yaw_rate_deg_s: Annotated[
        float,
        Field(
            gt=0,
            le=180,
            description="Cap of the commanded yaw's rate; autopilots do not all cap it themselves. Larger: turns sooner, with more blurred pictures (deg/s).",
        ),
    ] = 30.0
    commit_distance_m: Annotated[
        float,
        Field(
            gt=0,
            le=20,
            description="Distance flown along a void before looking towards the goal again. Larger: wider detours, fewer turns (m).",
        ),
    ] = 1.5
    wall_k: Annotated[
        int,
        Field(
            ge=1,
            le=20,
            description="Single-plane answers needed among the last wall_n to call it a wall. Larger: fewer turns for a doubtful wall, and later ones for a real one.",
        ),
    ] = 2
    wall_n: Annotated[
        int,
        Field(
            ge=1,
            le=20,
            description="Window of answers that wall_k counts in. Larger: older answers count too, walls are called more often.",
        ),
    ] = 3
    wall_limit_m: Annotated[
        float,
        Field(
            gt=0,
            le=50,
            description="A plane further away than this is not a wall yet. Larger: turns earlier (m).",
        ),
    ] = 2.0
    wall_margin_m: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="Added to min(goal, wall_limit_m) when a plane's range is judged. Larger: turns earlier (m).",
        ),
    ] = 0.5
    turn_step_deg: Annotated[
        float,
        Field(
            gt=0,
            le=90,
            description="Yaw step of a turn in front of a wall; at most half the field of view. Larger: a way out is found in fewer looks, a narrow one may lie between two (deg).",
        ),
    ] = 30.0
    probe_step_m: Annotated[
        float,
        Field(
            gt=0,
            le=2,
            description="Step flown to get parallax after a turn; must exceed the detector's baseline. Larger: a surer answer, and further flown without one (m).",
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
            gt=0,
            le=60,
            description="HOLD without parallax for this long, planner wants to move: PROBE. Larger: waits longer before it moves to see (s).",
        ),
    ] = 1.0
    arrive_radius_m: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="A goal nearer than this, stationary, is flown to directly. Larger: trusts the planner further from the goal (m).",
        ),
    ] = 0.6
    goal_settle_s: Annotated[
        float,
        Field(
            ge=0,
            le=60,
            description="A goal that has not moved for this long is stationary. Larger: arrives later; smaller: a slowly moving goal counts as reached (s).",
        ),
    ] = 1.0
    episode_distance_m: Annotated[
        float,
        Field(
            gt=0,
            le=50,
            description="An avoidance episode (side of turn, blocked bearings) ends after this distance. Larger: keeps to the side it chose for longer (m).",
        ),
    ] = 3.0
    redetect_distance_m: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="An answer is used up after this distance from its frame. Larger: flies further by what it saw before (m).",
        ),
    ] = 1.0
    redetect_yaw_deg: Annotated[
        float,
        Field(
            gt=0,
            le=180,
            description="An answer is used up after this much yaw from its frame. Larger: turns further by what it saw before (deg).",
        ),
    ] = 25.0
    detection_max_age_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="Greatest age of an answer while moving. Larger: fewer stops, flies longer by what it saw before (s).",
        ),
    ] = 2.0
    detection_max_age_hover_s: Annotated[
        float,
        Field(
            gt=0,
            le=600,
            description="Greatest age of an answer at rest. Larger: probes less often; what has moved meanwhile is noticed later (s).",
        ),
    ] = 10.0
    moving_m_s: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Above this speed the vehicle counts as moving. Larger: the longer age at rest holds up to higher speeds (m/s).",
        ),
    ] = 0.15
    bad_reports_to_hold: Annotated[
        int,
        Field(
            ge=1,
            le=20,
            description="Reports without an answer in a row (too little texture, blurred, ...; not: no motion) that end the last answer. Larger: flies on through short gaps of sight.",
        ),
    ] = 2
    min_confidence: Annotated[
        float,
        Field(
            ge=0,
            le=1,
            description="Answers that are less sure than this count as none, and what they measured is not flown by: HOLD. Only the detector's method parallax says how sure it is. Larger: safer, stands more often.",
        ),
    ] = 0.3
    probe_timeout_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="A probe that brought no answer in this time has failed. Larger: waits longer for a slow detector (s).",
        ),
    ] = 5.0
    report_timeout_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="No report of any kind from the worker for this long: vision counts as dead. Larger: noticed later; smaller: a slow detector counts as dead (s).",
        ),
    ] = 2.0
    pose_max_age_s: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Greatest age of the pose. Larger: gaps of telemetry are flown through, by an older place (s).",
        ),
    ] = 0.5
    planner_timeout_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="Silence after which the planner's goal is forgotten. Larger: an episode of avoidance outlives longer pauses (s).",
        ),
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
            description="HOLD for this long while the planner wants to move: give up, announced. Larger: tries for longer (s).",
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
