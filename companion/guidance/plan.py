"""What the present state set out to do: the place it holds, the turn, the probe, the episode they belong to."""

from __future__ import annotations

import math

from companion.config import GuidanceConfig
from companion.guidance.coordinates import heading_rad, wrap_rad
from companion.guidance.memory import Episode
from companion.guidance.observation import Pose
from companion.guidance.situation import Evidence

TURN_DONE_RAD = math.radians(5.0)
"""A turn that is this close to its end is done."""
_OPEN_M = 2.0
"""A side counts as freer only for a way that leads at least this far."""
_CLEARLY_M = 0.7
"""A side is freer than the other where it leads this much further."""
_DEAD_AHEAD_RAD = math.radians(5.0)
_ALIGN_SPARE_RAD = math.radians(30.0)
_SAME_DIRECTION_RAD = math.radians(15.0)
_BLIND = "camera axis"
_PROBE_MADE_SHARE = 0.5

Place = tuple[float, float]
"""North and east in local NED, m."""


class Plan:
    """Memory of the manoeuvre; it is made when a state is entered and read while it lasts.

    Parameters
    ----------
    config
        Limits and distances.
    evidence
        What is known of the world.
    """

    def __init__(self, config: GuidanceConfig, evidence: Evidence) -> None:
        self._config = config
        self._evidence = evidence
        self.episode: Episode | None = None
        self.anchor: Place | None = None
        self.anchor_down_m = 0.0
        self.anchor_yaw_rad = 0.0
        self.turns_along_rad: float | None = None
        self._align_look_rad = 0.0
        self._align_rest_rad = 0.0
        self.steer_start: Place = (0.0, 0.0)
        self.turn_target_rad = 0.0
        self.probed = ""
        self.probe_target: Place = (0.0, 0.0)
        self._probe_from: Place = (0.0, 0.0)
        self.probe_yaw_rad = 0.0
        self.probe_down_m = 0.0

    def set_limits(self, config: GuidanceConfig) -> None:
        """Take other limits; what has begun goes on, to the targets that it began with."""
        self._config = config

    def forget(self) -> None:
        """Forget episode and anchor: the mode was left, or the local frame is another one."""
        self.episode = None
        self.anchor = None
        self.turns_along_rad = None

    def end_episode_left_behind(self, pose: Pose) -> None:
        """End the episode where the vehicle has left its place."""
        if self.episode is not None and self.episode.over(pose, self._config.episode_distance_m):
            self.episode = None

    def set_anchor(self, pose: Pose) -> None:
        """Hold here, at the present heading."""
        self.anchor = (pose.north_m, pose.east_m)
        self.anchor_down_m = pose.down_m
        self.anchor_yaw_rad = heading_rad(pose.q_ned_from_body)

    def begin_or_keep_episode(self, pose: Pose) -> Episode:
        """Return the episode of this place, in which the goal's bearing is blocked now."""
        episode = self.episode
        if episode is None or episode.over(pose, self._config.episode_distance_m):
            episode = self.episode = Episode(pose.north_m, pose.east_m)
        bearing = self._goal_bearing_rad(pose)
        if bearing is not None:
            episode.block(bearing, pose)
        return episode

    def begin_align(self, look_rad: float, off_axis_rad: float) -> None:
        """Take note of how far there is to turn until the goal is in view."""
        self._align_look_rad = look_rad
        self._align_rest_rad = off_axis_rad + _ALIGN_SPARE_RAD

    def aligned_in_vain(self, look_rad: float) -> bool:
        """Take the camera's azimuth while aligning; return whether a goal that stands still would be in view by now."""
        self._align_rest_rad -= abs(wrap_rad(look_rad - self._align_look_rad))
        self._align_look_rad = look_rad
        return self._align_rest_rad <= 0.0

    def turns_along(self, body_bearing_rad: float | None) -> bool:
        """Whether a goal in this direction from the nose was found to turn with the vehicle."""
        if self.turns_along_rad is None or body_bearing_rad is None:
            return False
        return abs(wrap_rad(body_bearing_rad - self.turns_along_rad)) <= _SAME_DIRECTION_RAD

    def begin_turn(self, pose: Pose, now_ns: int) -> None:
        """Choose the side, once for an episode, and where the next step of the turn ends."""
        episode = self.episode
        if episode is None:
            return
        look = self._evidence.look_rad(pose)
        if episode.begin_turn(pose):
            episode.side = self._freer_side(pose, look, now_ns) or self._goal_side(pose, look)
        # From where the last turn was to end, not from where it was found done: twelve steps of 30 are 360.
        goes_on = episode.sweep_rad > 0 and abs(wrap_rad(self.turn_target_rad - look)) <= 2 * TURN_DONE_RAD
        start = self.turn_target_rad if goes_on else look
        self.turn_target_rad = wrap_rad(start + episode.side * math.radians(self._config.turn_step_deg))

    def begin_probe(self, pose: Pose, now_ns: int) -> None:
        """Choose where to step, and take only answers from now on: those before were at another heading."""
        look = self._evidence.look_rad(pose)
        choice = self.probe_choice(pose, look, now_ns)
        self.probe_yaw_rad = heading_rad(pose.q_ned_from_body)
        self.probe_down_m = pose.down_m
        self._probe_from = (pose.north_m, pose.east_m)
        self._evidence.take_answers_after(now_ns)
        if choice is None:
            self.probed = ""
            self.probe_target = (pose.north_m, pose.east_m)
            return
        self.probed, self.probe_target = choice
        if self.probed == _BLIND:
            if self.episode is None:
                self.episode = Episode(pose.north_m, pose.east_m)
            self.episode.bootstrap(look)

    def cut_probe_short(self, pose: Pose) -> None:
        """Take back a blind step of which less than half was made when something else began: it may be made again."""
        moved_m = math.dist(self._probe_from, (pose.north_m, pose.east_m))
        least_m = _PROBE_MADE_SHARE * self._config.probe_step_m
        if self.probed == _BLIND and self.episode is not None and moved_m < least_m:
            self.episode.forget_last_bootstrap()

    def probe_choice(self, pose: Pose, look_rad: float, now_ns: int) -> tuple[str, Place] | None:
        """Return why and where a probe would step, or None where there is no way for it."""
        config, evidence = self._config, self._evidence
        step_m = config.probe_step_m
        north_m, east_m = pose.north_m, pose.east_m

        def along(azimuth_rad: float) -> Place:
            return north_m + step_m * math.cos(azimuth_rad), east_m + step_m * math.sin(azimuth_rad)

        free = evidence.seen.free_azimuths(step_m + config.step_margin_m, pose, evidence.speed_m_s, now_ns)
        free = [way for way in free if evidence.ways.reach_m(way[0], pose) >= step_m]
        if free:
            azimuth, _ = min(free, key=lambda item: abs(wrap_rad(item[0] - look_rad)))
            return "seen free", along(azimuth)
        back = evidence.track.back(north_m, east_m, step_m)
        if back is not None:
            azimuth = math.atan2(back[1] - east_m, back[0] - north_m)
            return "flown track", along(azimuth)
        known_m = evidence.free_m(look_rad, pose, now_ns)
        # What is measured free for the step and its margin, and was not looked through at its sides, is no worse than what nobody has measured.
        blocked = known_m is not None and known_m < step_m + config.step_margin_m
        half_step = math.radians(config.turn_step_deg) / 2
        used = self.episode is not None and self.episode.was_bootstrapped(look_rad, half_step)
        if config.bootstrap_probe and not blocked and not used:
            return _BLIND, along(look_rad)
        return None

    def _goal_side(self, pose: Pose, look_rad: float) -> int:
        bearing = self._goal_bearing_rad(pose)
        to_goal = 0.0 if bearing is None else wrap_rad(bearing - look_rad)
        return -1 if to_goal < -_DEAD_AHEAD_RAD else 1

    def _freer_side(self, pose: Pose, look_rad: float, now_ns: int) -> int:
        """Return the side on which a way is measured to lead clearly further, 0 where there is none."""
        evidence = self._evidence
        furthest = {-1: 0.0, 1: 0.0}
        for azimuth, free_m in evidence.seen.free_azimuths(_OPEN_M, pose, evidence.speed_m_s, now_ns):
            off_rad = wrap_rad(azimuth - look_rad)
            side = 1 if off_rad > 0 else -1
            if abs(off_rad) <= math.pi / 2:
                furthest[side] = max(furthest[side], free_m)
        if abs(furthest[1] - furthest[-1]) < _CLEARLY_M:
            return 0
        return 1 if furthest[1] > furthest[-1] else -1

    def _goal_bearing_rad(self, pose: Pose) -> float | None:
        goal = self._evidence.goal.position
        return None if goal is None else math.atan2(goal[1] - pose.east_m, goal[0] - pose.north_m)
