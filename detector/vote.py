"""The vote between vanishing point and lowest flow (paper section 2.4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.clusters import nearest_magnitudes


def elect(
    candidates_px: NDArray[np.float64],
    lmcc_px: NDArray[np.float64],
    lmcc_magnitude: float,
    end_px: NDArray[np.float64],
    magnitudes: NDArray[np.float64],
    k: int,
    tolerance: float = 0.05,
) -> NDArray[np.float64] | None:
    """Return the vanishing-point candidate nearest to the LMCC if the flow there is that of the LMCC, else None.

    Elected means ``|L_VP - L_LMCC| < tolerance * L_LMCC``, L_VP from the same k nearest vectors. The text's "0.05 %"
    contradicts its own formula, which is 5 %. Another flow says that a nearer object hides the vanishing point.

    Parameters
    ----------
    candidates_px
        (C, 2).
    lmcc_px, lmcc_magnitude
        (2,) the lowest-magnitude cluster centre, and its magnitude.
    end_px, magnitudes
        (N, 2) and (N,) the flow field.
    k
        Nearest neighbours.
    tolerance
        Share of the LMCC's magnitude.
    """
    if len(candidates_px) == 0:
        return None
    squared = ((candidates_px - lmcc_px) ** 2).sum(axis=1)
    nearest = candidates_px[int(np.argmin(squared))]
    magnitude = float(nearest_magnitudes(nearest[None, :], end_px, magnitudes, k)[0])
    if abs(magnitude - lmcc_magnitude) < tolerance * lmcc_magnitude:
        return np.asarray(nearest, np.float64)
    return None
