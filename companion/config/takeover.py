"""``[interception]``: by which way setpoints of ours come to the autopilot. Exactly one holds: no autopilot arbitrates."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.section import Section


class InterceptionConfig(Section):
    """How setpoints come to the switch S, and what takes the vehicle over from its own mission."""

    mode: Annotated[
        Literal["inline", "takeover", "addressed"],
        Field(
            description="inline: a planner's setpoints are rewritten on their way. takeover: the autopilot flies its own mission; the companion flies OFFBOARD (PX4) or GUIDED (ArduPilot) while the mission's way is not free. addressed: setpoints sent to our own component go out to the autopilot; others are treated as inline."
        ),
    ] = "inline"
    stream_rate_hz: Annotated[
        float,
        Field(
            ge=5, le=50, description="takeover: rate of our setpoints (Hz). Larger: smoother, more traffic."
        ),
    ] = 20.0
    stream_before_s: Annotated[
        float,
        Field(
            ge=1,
            le=5,
            description="takeover: the way must be blocked, and setpoints stream, for this long before the mode is asked for (s). Larger: fewer needless takeovers, and the mission flies on for longer.",
        ),
    ] = 1.0
    give_back_s: Annotated[
        float,
        Field(
            ge=0.5,
            le=30,
            description="takeover: the way must be free for this long before the mission is given back (s); twice as long after each takeover within half a minute of the last. Larger: fewer changes of mode.",
        ),
    ] = 2.0
    goal_max_age_s: Annotated[
        float,
        Field(
            ge=1,
            le=10,
            description="takeover: a mission item is the goal for this long after the last MISSION_CURRENT that names it, and likewise POSITION_TARGET_GLOBAL_INT in the mission (s). Larger: lost messages do less harm, a changed mission is noticed later.",
        ),
    ] = 3.0
    latched_goal_max_age_s: Annotated[
        float,
        Field(
            ge=1,
            le=600,
            description="takeover: a goal from POSITION_TARGET_GLOBAL_INT, which is not sent while we fly, is good for this long (s). Larger: longer ways around.",
        ),
    ] = 60.0
    fault_s: Annotated[
        float,
        Field(
            ge=0.1,
            le=2,
            description="takeover: after a failure of camera, worker, pose or goal that lasts this long while we fly, the autopilot is asked for its own Hold or Brake, and our setpoints end (s). Larger: short gaps are held through.",
        ),
    ] = 0.5
