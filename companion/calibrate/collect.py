"""Which images to take views from: different ones, of a board that is held still. Pure."""

from __future__ import annotations

import numpy as np

from companion.calibrate.board import View

_DIFFERENT = 0.04
"""Mean movement of corners, in image widths, that makes another view."""
_STILL = 0.004
"""Mean movement of corners from frame to frame, in image widths, of a board that is held still."""


class ViewCollector:
    """Takes views that are worth keeping.

    Parameters
    ----------
    width_px
        Of the images.
    needs_stillness
        Whether the board moves in front of a running camera: then a view counts when the board is where it was
        in the frame before, because one that moves is blurred, and skewed by a rolling shutter.
    """

    def __init__(self, width_px: int, *, needs_stillness: bool) -> None:
        self._width_px = width_px
        self._needs_stillness = needs_stillness
        self._before: View | None = None
        self.views: list[View] = []

    def offer(self, view: View | None) -> bool:
        """Take the view of the next frame, or None where no board was found; return whether it was kept."""
        before, self._before = self._before, view
        if view is None:
            return False
        if self._needs_stillness and (before is None or self._moved(before, view) > _STILL):
            return False
        if any(self._moved(kept, view) < _DIFFERENT for kept in self.views):
            return False
        self.views.append(view)
        return True

    def _moved(self, earlier: View, later: View) -> float:
        """Return the mean movement of the corners that both show, in image widths; infinite where there are none."""
        places = {tuple(corner): at for at, corner in enumerate(earlier.board_m[:, :2].tolist())}
        pairs = [
            (places[corner], at)
            for at, corner in enumerate(map(tuple, later.board_m[:, :2].tolist()))
            if corner in places
        ]
        if not pairs:
            return float("inf")
        first, second = np.array(pairs).T
        moved_px = np.linalg.norm(later.image_px[second] - earlier.image_px[first], axis=1)
        return float(moved_px.mean()) / self._width_px
