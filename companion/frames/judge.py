"""Whether a camera still works: a pure judgement of what it delivered, against one deadline."""

from __future__ import annotations

from collections import Counter
from typing import Literal

Verdict = Literal["good", "wrong_size", "repeated"]

_FIRST_IMAGE_NS = 3_000_000_000
"""A camera that has just been opened may take this long: sensors start, exposure settles."""


class ImageJudge:
    """Counts only whole, new pictures of the right size; says when the last one was too long ago.

    A picture that is the same as the one before, bit for bit, is not a new one: a sensor has noise, so it comes
    from a driver that repeats itself, and its time stamp is not true.

    Parameters
    ----------
    timeout_s
        Longest time without a new picture.
    size_px
        (width, height) that is wanted; None: that of the first picture.
    """

    def __init__(self, timeout_s: float, size_px: tuple[int, int] | None = None) -> None:
        self._timeout_s = timeout_s
        self._size_px = size_px
        self._digest: int | None = None
        self._due_ns = 0
        self._waited_s = timeout_s
        self._since_good: Counter[str] = Counter()

    def opened(self, now_ns: int) -> None:
        """Hear that the camera has been opened: its first picture is due."""
        self._waited_s = max(self._timeout_s, _FIRST_IMAGE_NS / 1e9)
        self._due_ns = now_ns + round(self._waited_s * 1e9)
        self._since_good.clear()

    def damaged(self, how: str) -> None:
        """Hear of an image that did not come whole."""
        self._since_good[f"only damaged images ({how})"] += 1

    def judge(self, size_px: tuple[int, int], digest: int, now_ns: int) -> Verdict:
        """Judge an image that came whole."""
        if self._size_px is None:
            self._size_px = size_px
        if size_px != self._size_px:
            found, wanted = ("{} x {} px".format(*size) for size in (size_px, self._size_px))
            self._since_good[f"only images of {found} instead of {wanted}"] += 1
            return "wrong_size"
        if digest == self._digest:
            self._since_good["the same picture again and again"] += 1
            return "repeated"
        self._digest = digest
        self._waited_s = self._timeout_s
        self._due_ns = now_ns + round(self._timeout_s * 1e9)
        self._since_good.clear()
        return "good"

    def overdue(self, now_ns: int) -> str | None:
        """Return what is wrong when the next picture is overdue, else None."""
        if now_ns < self._due_ns:
            return None
        what = self._since_good.most_common(1)[0][0] if self._since_good else "no image"
        return f"{what} for {self._waited_s:g} s"
