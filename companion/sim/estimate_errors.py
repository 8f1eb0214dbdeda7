"""How an estimator errs indoors: a position that drifts and wavers, a heading that wanders. Seeded; no clock.

The autopilot flies by its estimate, so the vehicle errs with it; its camera sees from where it really is.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.guidance.coordinates import wrap_rad
from companion.sim.vehicle import Target, Vector3, VehicleState

_POSITION_CORRELATION_S: Final = 1.0
_HEADING_CORRELATION_S: Final = 10.0
_VERTICAL_SHARE: Final = 0.3
"""Height has a range finder or a barometer: it errs by less."""


@dataclass(frozen=True, slots=True)
class EstimateErrors:
    """Sizes of the errors; all 0 is a perfect estimate.

    Attributes
    ----------
    position_drift_m_per_sqrt_s
        Random walk of the horizontal position, each axis: 0.05 is 0.4 m after a minute.
    position_noise_m
        Standard deviation of an error of the position, each axis, that comes and goes within about a second.
    heading_noise_deg
        Standard deviation of an error of the heading that comes and goes within about ten seconds.
    """

    position_drift_m_per_sqrt_s: float = 0.0
    position_noise_m: float = 0.0
    heading_noise_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative, got {value}")


class ErringEstimate:
    """The errors of one flight as they develop.

    Parameters
    ----------
    errors
        Their sizes.
    seed
        The same seed and steps give the same errors, bit for bit.
    """

    def __init__(self, errors: EstimateErrors, seed: int) -> None:
        self._errors = errors
        self._random = np.random.default_rng(seed)
        self._drift_m = np.zeros(3)
        self._scale = np.array([1.0, 1.0, _VERTICAL_SHARE])
        self._noise_m = errors.position_noise_m * self._scale * self._random.standard_normal(3)
        self._heading_rad = math.radians(errors.heading_noise_deg) * float(self._random.standard_normal())

    @property
    def position_error_ned_m(self) -> Vector3:
        """Estimate less truth."""
        north, east, down = (self._drift_m + self._noise_m).tolist()
        return north, east, down

    @property
    def heading_error_rad(self) -> float:
        """Estimate less truth."""
        return self._heading_rad

    def step(self, dt_s: float) -> None:
        """Let the errors develop for ``dt_s`` seconds."""
        errors, random = self._errors, self._random
        walk = errors.position_drift_m_per_sqrt_s * math.sqrt(dt_s)
        self._drift_m += walk * self._scale * random.standard_normal(3)
        keep, renew = _markov(dt_s, _POSITION_CORRELATION_S)
        self._noise_m = keep * self._noise_m + (
            renew * errors.position_noise_m * self._scale * random.standard_normal(3)
        )
        keep, renew = _markov(dt_s, _HEADING_CORRELATION_S)
        self._heading_rad = keep * self._heading_rad + (
            renew * math.radians(errors.heading_noise_deg) * float(random.standard_normal())
        )

    def estimate_of(self, truth: VehicleState) -> VehicleState:
        """Return the state that is believed."""
        north, east, down = truth.position_ned_m
        d_north, d_east, d_down = self.position_error_ned_m
        return dataclasses.replace(
            truth,
            position_ned_m=(north + d_north, east + d_east, down + d_down),
            yaw_rad=wrap_rad(truth.yaw_rad + self._heading_rad),
        )

    def truth_of(self, target: Target) -> Target:
        """Return where a target of the estimate's frame really is."""
        north, east, down = (
            None if wanted is None else wanted - error
            for wanted, error in zip(target.position_ned_m, self.position_error_ned_m, strict=True)
        )
        yaw_rad = None if target.yaw_rad is None else wrap_rad(target.yaw_rad - self._heading_rad)
        return dataclasses.replace(target, position_ned_m=(north, east, down), yaw_rad=yaw_rad)


def _markov(dt_s: float, correlation_s: float) -> tuple[float, float]:
    """Return what is kept of a first-order Gauss-Markov process over a step, and how much comes anew."""
    keep = math.exp(-dt_s / correlation_s)
    return keep, math.sqrt(1.0 - keep * keep)
