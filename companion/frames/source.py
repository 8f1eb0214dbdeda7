"""The interface of a frame source: one small protocol, one choice of back end."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Frame:
    """One grey image and when it was exposed.

    Attributes
    ----------
    image
        (H, W) uint8. It is good until the next frame is asked for: a camera may fill its memory again then.
    time_ns
        Our monotonic time of the exposure, or of the arrival where ``time_of`` says so.
    seq
        Number of the frame, from 0, counting those dropped before they got here.
    time_of
        What ``time_ns`` is the time of: not every camera tells when it exposed.
    """

    image: NDArray[np.uint8]
    time_ns: int
    seq: int
    time_of: Literal["exposure", "arrival"] = "exposure"


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
