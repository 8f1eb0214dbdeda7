"""The interface of a frame source: one small protocol, one choice of back end."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Frame:
    """One grey image and when it was exposed.

    Attributes
    ----------
    image
        (H, W) uint8.
    time_ns
        Our monotonic time of the exposure.
    seq
        Number of the frame, from 0, counting those dropped before they got here.
    """

    image: NDArray[np.uint8]
    time_ns: int
    seq: int


class FrameSource(Protocol):
    """Frames, newest wins. ``async with`` is the lifetime; capture never blocks the event loop."""

    async def __aenter__(self) -> Self: ...

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None: ...

    def frames(self) -> AsyncIterator[Frame]:
        """Yield frames as they come; ends when the source ends.

        Raises
        ------
        companion.errors.SourceError
            When the source fails; the message names it and says what is wrong.
        """
        ...
