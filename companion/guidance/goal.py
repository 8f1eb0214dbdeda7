"""The planner's goal over time: since when it stands still, and when it is another one."""

from __future__ import annotations

import math

from companion.config import GuidanceConfig

_NEW_GOAL_M = 0.5
"""A goal that jumps further than this from one setpoint to the next is a new one."""
_GOAL_SPEED_M_S = 3.0
"""Up to this speed a goal that is streamed slowly is taken to move, not to be a new one each time."""
_GOAL_STILL_M = 0.1


class Goal:
    """Follows the goal from setpoint to setpoint.

    Parameters
    ----------
    config
        ``planner_timeout_s``: the silence after which a goal is forgotten.
    """

    def __init__(self, config: GuidanceConfig) -> None:
        self.set_limits(config)
        self.position: tuple[float, float] | None = None
        self._before: tuple[float, float] | None = None
        self._seen_ns = 0
        self._still: tuple[float, float] = (0.0, 0.0)
        self._still_since_ns = 0

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take another limit; the goal stays."""
        self._timeout_s = config.planner_timeout_s

    def forget(self) -> None:
        """Forget the goal: the next one is new."""
        self.position = self._before = None

    def still_s(self, now_ns: int) -> float:
        """Return for how long the goal has not moved."""
        return (now_ns - self._still_since_ns) / 1e9

    def note(self, goal: tuple[float, float], now_ns: int) -> bool:
        """Take the goal (north, east in m) of one setpoint; return whether it is a new one."""
        since_s = (now_ns - self._seen_ns) / 1e9
        silent = since_s > self._timeout_s
        self._seen_ns = now_ns
        jump_m = max(_NEW_GOAL_M, _GOAL_SPEED_M_S * since_s)
        if self.position is None or silent:
            is_new, self._before = True, None
        elif math.dist(self.position, goal) <= jump_m:
            is_new = False
        else:
            # Two planners that take turns do not bring a new goal each time.
            before, self._before = self._before, self.position
            is_new = before is None or math.dist(before, goal) > jump_m
            self._still, self._still_since_ns = goal, now_ns
        if is_new or math.dist(self._still, goal) > _GOAL_STILL_M:
            self._still, self._still_since_ns = goal, now_ns
        self.position = goal
        return is_new
