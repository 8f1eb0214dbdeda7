"""The vehicle's poses by our time: telemetry in, a pose at any recent instant out.

LOCAL_POSITION_NED and ATTITUDE (or ATTITUDE_QUATERNION) carry the autopilot's time since boot, arrive at
different rates and with varying delay. An image needs the attitude of the moment it was exposed.
https://mavlink.io/en/messages/common.html#LOCAL_POSITION_NED
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from companion.guidance.coordinates import Quaternion
from companion.guidance.observation import Pose

_CLOCK_DRIFT = 200e-6
"""Greatest relative drift of two quartz clocks that the mapping follows."""
_REBOOT_NS = 1_000_000_000
"""The autopilot's time going back by more than this means that it has restarted."""
_SYNC_KEPT_NS = 60_000_000_000
"""A measured offset is used for this long; after that it may be off by more than the link's delay."""
_MOST_DELAY_NS = 1_000_000_000
_EARLY_NS = 5_000_000
"""A measured offset that makes a message arrive this much before it was sent is not that of the time since boot."""
_JUMP_PREDICTED_S = 1.0
_KEEP_NS = 3_000_000_000
_MAX_GAP_NS = 500_000_000
"""Samples further apart than this are not interpolated between: what happened there is not known."""


class BootClock:
    """Maps the autopilot's time since boot to our monotonic time.

    A message can be late but never early, so the least difference seen between arrival and boot time
    is the best offset; it is allowed to grow slowly so that it follows the drift between two clocks.
    That offset is too large by the least delay of the link. An offset measured there and back (TIMESYNC)
    is not, and is used while it is fresh.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._last_arrival_ns = 0
        self._last_boot_ns = 0
        self._synced: tuple[int, int] | None = None

    def synchronise(self, offset_ns: int, now_ns: int) -> bool:
        """Take a measured offset; return False where it cannot be that of the time since boot.

        Parameters
        ----------
        offset_ns
            Our time less the autopilot's time since boot.
        now_ns
            Our time.
        """
        if self._offset_ns is None or not -_EARLY_NS <= self._offset_ns - offset_ns <= _MOST_DELAY_NS:
            return False
        self._synced = (offset_ns, now_ns)
        return True

    def to_ours_ns(self, time_boot_ms: int, arrival_ns: int) -> tuple[int, bool]:
        """Return our time of a message, and whether the autopilot's clock has restarted.

        Parameters
        ----------
        time_boot_ms
            The message's own time stamp.
        arrival_ns
            When it reached us.
        """
        boot_ns = time_boot_ms * 1_000_000
        sample = arrival_ns - boot_ns
        restarted = self._offset_ns is not None and boot_ns < self._last_boot_ns - _REBOOT_NS
        if self._offset_ns is None or restarted:
            self._offset_ns = sample
            self._synced = None
        else:
            grown = self._offset_ns + int(_CLOCK_DRIFT * max(0, arrival_ns - self._last_arrival_ns))
            self._offset_ns = min(sample, grown)
        self._last_arrival_ns = arrival_ns
        self._last_boot_ns = boot_ns
        offset_ns = self._offset_ns
        if self._synced is not None and arrival_ns - self._synced[1] <= _SYNC_KEPT_NS:
            offset_ns = min(offset_ns, self._synced[0])  # no message arrives before it was sent
        return boot_ns + offset_ns, restarted


@dataclass(frozen=True, slots=True)
class _Position:
    time_ns: int
    ned_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Attitude:
    time_ns: int
    q: Quaternion
    body_rates_rad_s: tuple[float, float, float]


_Sample = TypeVar("_Sample", _Position, _Attitude)


class PoseBuffer:
    """Recent positions and attitudes, interpolated at any instant.

    Parameters
    ----------
    jump_m
        A position further than this from where the last velocity leads, or from the last one after more
        than a second of silence, is an estimator reset.
    max_extrapolation_s
        Longest time past the newest sample that a pose is extrapolated with velocity and body rates.
    """

    def __init__(self, *, jump_m: float, max_extrapolation_s: float = 0.1) -> None:
        self._jump_m = jump_m
        self._max_extrapolation_ns = int(max_extrapolation_s * 1e9)
        self._clock = BootClock()
        self._positions: deque[_Position] = deque()
        self._attitudes: deque[_Attitude] = deque()

    def synchronise(self, offset_ns: int, now_ns: int) -> bool:
        """Take our time less the autopilot's time since boot, as TIMESYNC measured it (`BootClock.synchronise`)."""
        return self._clock.synchronise(offset_ns, now_ns)

    def clear(self) -> None:
        """Forget all samples (estimator reset); the clock mapping stays."""
        self._positions.clear()
        self._attitudes.clear()

    def add_position(
        self,
        time_boot_ms: int,
        arrival_ns: int,
        ned_m: tuple[float, float, float],
        velocity_m_s: tuple[float, float, float],
    ) -> bool:
        """Take one LOCAL_POSITION_NED; return True when it shows an estimator reset or a restart.

        After a reset only this sample is kept: nothing from before is in the same frame. Samples that
        are not finite are ignored.
        """
        if not all(map(math.isfinite, (*ned_m, *velocity_m_s))):
            return False
        time_ns, restarted = self._clock.to_ours_ns(time_boot_ms, arrival_ns)
        sample = _Position(time_ns, ned_m, velocity_m_s)
        reset = restarted or self._is_jump(sample)
        if reset:
            self.clear()
        _append(self._positions, sample)
        return reset

    def add_attitude(
        self,
        time_boot_ms: int,
        arrival_ns: int,
        q_ned_from_body: Quaternion,
        body_rates_rad_s: tuple[float, float, float],
    ) -> bool:
        """Take one ATTITUDE or ATTITUDE_QUATERNION; return True when the autopilot has restarted."""
        if not all(map(math.isfinite, (*q_ned_from_body, *body_rates_rad_s))):
            return False
        norm = math.hypot(*q_ned_from_body)
        if not 0.5 < norm < 2.0:
            return False
        w, x, y, z = (c / norm for c in q_ned_from_body)
        time_ns, restarted = self._clock.to_ours_ns(time_boot_ms, arrival_ns)
        if restarted:
            self.clear()
        _append(self._attitudes, _Attitude(time_ns, (w, x, y, z), body_rates_rad_s))
        return restarted

    def newest(self) -> Pose | None:
        """Return the newest pose that needs no extrapolation, or None without position and attitude."""
        if not self._positions or not self._attitudes:
            return None
        return self.at(min(self._positions[-1].time_ns, self._attitudes[-1].time_ns))

    def at(self, time_ns: int) -> Pose | None:
        """Return the pose at ``time_ns``, or None when the samples do not reach there.

        Between two samples it is interpolated; past the newest it is extrapolated for at most
        ``max_extrapolation_s``; before the oldest, or across a gap of half a second, it is not known.
        """
        position = self._position_at(time_ns)
        attitude = self._attitude_at(time_ns)
        if position is None or attitude is None:
            return None
        return Pose(time_ns, *position, attitude)

    def speed_m_s(self) -> float | None:
        """Return the newest horizontal speed, or None without a position."""
        if not self._positions:
            return None
        vn, ve, _ = self._positions[-1].velocity_m_s
        return math.hypot(vn, ve)

    def _is_jump(self, sample: _Position) -> bool:
        if not self._positions:
            return False
        last = self._positions[-1]
        dt_s = (sample.time_ns - last.time_ns) / 1e9
        if dt_s < 0:
            return False
        if dt_s > _JUMP_PREDICTED_S:  # no velocity leads that far: what happened meanwhile is not known
            return math.dist(sample.ned_m, last.ned_m) > self._jump_m
        off_m = math.dist(
            sample.ned_m,
            [
                p + 0.5 * (v0 + v1) * dt_s
                for p, v0, v1 in zip(last.ned_m, last.velocity_m_s, sample.velocity_m_s, strict=True)
            ],
        )
        return off_m > self._jump_m

    def _position_at(self, time_ns: int) -> tuple[float, float, float] | None:
        found = _around(self._positions, time_ns, self._max_extrapolation_ns)
        if found is None:
            return None
        before, after = found
        if after is None:
            dt_s = (time_ns - before.time_ns) / 1e9
            n, e, d = (p + v * dt_s for p, v in zip(before.ned_m, before.velocity_m_s, strict=True))
            return n, e, d
        f = _fraction(before.time_ns, after.time_ns, time_ns)
        n, e, d = (a + f * (b - a) for a, b in zip(before.ned_m, after.ned_m, strict=True))
        return n, e, d

    def _attitude_at(self, time_ns: int) -> Quaternion | None:
        found = _around(self._attitudes, time_ns, self._max_extrapolation_ns)
        if found is None:
            return None
        before, after = found
        if after is None:
            return _turned(before.q, before.body_rates_rad_s, (time_ns - before.time_ns) / 1e9)
        return _slerp(before.q, after.q, _fraction(before.time_ns, after.time_ns, time_ns))


def _append(samples: deque[_Sample], sample: _Sample) -> None:
    if samples and sample.time_ns <= samples[-1].time_ns:
        return
    samples.append(sample)
    while samples[0].time_ns < sample.time_ns - _KEEP_NS:
        samples.popleft()


def _around(
    samples: Sequence[_Sample], time_ns: int, max_extrapolation_ns: int
) -> tuple[_Sample, _Sample | None] | None:
    """Return the samples before and after ``time_ns``; after is None past the newest one."""
    after = bisect_right(samples, time_ns, key=lambda sample: sample.time_ns)
    if after == 0:
        return None
    before = samples[after - 1]
    if after == len(samples):
        return (before, None) if time_ns - before.time_ns <= max_extrapolation_ns else None
    if samples[after].time_ns - before.time_ns > _MAX_GAP_NS:
        return None
    return before, samples[after]


def _fraction(before_ns: int, after_ns: int, time_ns: int) -> float:
    return (time_ns - before_ns) / (after_ns - before_ns)


def _slerp(a: Quaternion, b: Quaternion, f: float) -> Quaternion:
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    sign = 1.0 if dot >= 0 else -1.0  # q and -q are the same attitude: take the short way
    angle = math.acos(min(1.0, abs(dot)))
    if angle < 1e-6:
        return b
    wa, wb = math.sin((1 - f) * angle) / math.sin(angle), sign * math.sin(f * angle) / math.sin(angle)
    w, x, y, z = (wa * p + wb * q for p, q in zip(a, b, strict=True))
    return w, x, y, z


def _turned(q: Quaternion, body_rates_rad_s: tuple[float, float, float], dt_s: float) -> Quaternion:
    """Return ``q`` after turning with constant body rates for ``dt_s``."""
    rate = math.hypot(*body_rates_rad_s)
    half = 0.5 * rate * dt_s
    if half < 1e-9:
        return q
    s = math.sin(half) / rate
    rw = math.cos(half)
    rx, ry, rz = (s * r for r in body_rates_rad_s)
    w, x, y, z = q
    return (
        w * rw - x * rx - y * ry - z * rz,
        w * rx + x * rw + y * rz - z * ry,
        w * ry - x * rz + y * rw + z * rx,
        w * rz + x * ry - y * rx + z * rw,
    )
