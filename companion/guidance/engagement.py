"""Whether setpoints are to be protected: who asked for it, and what must be there first (pure).

Engaged, the switch S treats the planner's setpoints; not engaged, they pass untouched. What fails *after* engaging never
disengages: the switch S holds then. So only somebody's decision lets the planner through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from companion.config import EngagementConfig

_HYSTERESIS_US: Final = 50
_NO_SIGNAL_US: Final = (0, 0xFFFF)
"""RC_CHANNELS: what a channel says that is not there. https://mavlink.io/en/messages/common.html#RC_CHANNELS"""
_LEAST_US, _MOST_US = 800, 2200
"""Receivers that have lost the transmitter send anything; what no stick can send is not a position."""
_POSITIONS_NEEDED: Final = 3
"""Equal positions in a row that move the switch: one glitch of the receiver must not let the planner through."""

ATTITUDE_OK: Final = 1
VELOCITY_OK: Final = 2
POSITION_RELATIVE_OK: Final = 8
POSITION_ABSOLUTE_OK: Final = 16
"""Bits of ESTIMATOR_STATUS.flags, the same in ArduPilot's EKF_STATUS_REPORT."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What is known of everything that protection needs.

    Attributes
    ----------
    heartbeat_ok
        The autopilot's HEARTBEAT was heard lately.
    pose
        Why the pose may not be measured from; None: it may.
    estimator_flags
        ESTIMATOR_STATUS.flags; None where the autopilot does not tell.
    frames, worker
        Why there are no frames at the floor rate, why the worker does not work; None: all is well.
    camera_model
        A camera file or a field of view is configured.
    """

    heartbeat_ok: bool
    pose: str | None
    estimator_flags: int | None
    frames: str | None
    worker: str | None
    camera_model: bool


def missing(inputs: Inputs) -> tuple[str, ...]:
    """Return, in words, what is missing to engage; nothing where all is there."""
    return tuple(
        reason
        for reason in (
            None if inputs.heartbeat_ok else "no heartbeat from the autopilot",
            inputs.pose,
            estimator_fault(inputs.estimator_flags),
            inputs.frames,
            inputs.worker,
            None if inputs.camera_model else "no camera model (camera.file or camera.hfov_deg)",
        )
        if reason is not None
    )


def estimator_fault(flags: int | None) -> str | None:
    """Return what an estimator says that it does not know, or None where it is well or says nothing."""
    if flags is None:
        return None
    known = (
        ("attitude", flags & ATTITUDE_OK),
        ("velocity", flags & VELOCITY_OK),
        ("position", flags & (POSITION_RELATIVE_OK | POSITION_ABSOLUTE_OK)),
    )
    lacks = [name for name, is_known in known if not is_known]
    return f"estimator has no {' and '.join(lacks)}" if lacks else None


class RcSwitch:
    """A two-position switch on the remote control, with hysteresis; a lost remote control moves nothing.

    Parameters
    ----------
    threshold_us
        Pulse width between its positions.
    """

    def __init__(self, threshold_us: int) -> None:
        self._threshold_us = threshold_us
        self._streak: tuple[bool, int] = (False, 0)
        self.is_up: bool | None = None

    def take(self, pulse_us: int) -> bool | None:
        """Take the channel's pulse width (us) of one RC_CHANNELS; return the position; None before the first."""
        if pulse_us in _NO_SIGNAL_US or not _LEAST_US <= pulse_us <= _MOST_US:
            self._streak = (False, 0)
            return self.is_up
        margin_us = 0 if self.is_up is None else -_HYSTERESIS_US if self.is_up else _HYSTERESIS_US
        up = pulse_us > self._threshold_us + margin_us
        last, times = self._streak
        self._streak = (up, times + 1 if up == last else 1)
        if self._streak[1] >= _POSITIONS_NEEDED:
            self.is_up = up
        return self.is_up


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of a request.

    Attributes
    ----------
    engaged
        Whether setpoints are protected now.
    accepted
        The request was carried out.
    why_not
        What speaks against it, in words.
    """

    engaged: bool
    accepted: bool
    why_not: tuple[str, ...] = ()


class Engagement:
    """Who decides, and what was decided.

    Parameters
    ----------
    config
        Who may decide, and what holds until then.
    """

    def __init__(self, config: EngagementConfig) -> None:
        self._by = config.by
        self._channel = config.rc_channel
        self._rc = RcSwitch(config.rc_threshold_us)
        self._engaged = config.by == "always" or config.engaged_at_start
        self._source = "at start"

    @property
    def off(self) -> str | None:
        """Why setpoints are not protected; None: they are."""
        return None if self._engaged else f"not engaged ({self._source})"

    def command(self, on: bool, inputs: Inputs, source: str) -> Answer:
        """Take a request of a ground station, by command or parameter; ``source`` names it for people."""
        if self._by == "always":
            return Answer(True, on, () if on else ("engagement.by is always",))
        if self._by == "rc":
            is_so = on == self._engaged
            return Answer(
                self._engaged,
                is_so,
                () if is_so else (f"RC channel {self._channel} decides (engagement.by)",),
            )
        return self._decide(on, inputs, source)

    def rc_channels(self, pulses_us: tuple[int, ...], inputs: Inputs) -> Answer | None:
        """Take the channels of one RC_CHANNELS; None where they ask for nothing new.

        The switch is a position, not an event: where something is missing, it engages as soon as that is there.
        """
        if self._by != "rc" or len(pulses_us) < self._channel:
            return None
        wanted = self._rc.take(pulses_us[self._channel - 1])
        if wanted is None or wanted == self._engaged:
            if wanted is not None:
                self._source = f"RC channel {self._channel}"
            return None
        return self._decide(wanted, inputs, f"RC channel {self._channel}")

    def _decide(self, on: bool, inputs: Inputs, source: str) -> Answer:
        if on == self._engaged:
            return Answer(self._engaged, True)
        why_not = missing(inputs) if on else ()
        if why_not:
            return Answer(False, False, why_not)
        self._engaged = on
        self._source = source
        return Answer(on, True)
