"""What every kind of camera has in common: it is opened, read with a time-out, and closed, all in one thread."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class CaptureError(Exception):
    """The camera is gone or has failed; it has to be opened again. The message says what happened."""


class DamagedImageError(Exception):
    """One image came damaged; the next one may be whole. The message says how it is damaged."""


@dataclass(frozen=True, slots=True)
class CapturedImage:
    """One image as a camera gave it.

    Attributes
    ----------
    image
        (H, W) uint8. It may look into the driver's own memory, with any strides.
    time_ns
        CLOCK_MONOTONIC of the exposure, or None where the camera does not tell.
    digest
        Of the image as it came: two alike are the same picture.
    lost
        Images that the driver dropped, or that were passed over undecoded, just before this one.
    give_back
        Tells the camera that nobody looks at the image any more. For any thread; never blocks.
    """

    image: NDArray[np.uint8]
    time_ns: int | None
    digest: int
    lost: int
    give_back: Callable[[], None]


class Capture(Protocol):
    """An open camera. Used by one thread, but for ``give_back`` of its images."""

    @property
    def facts(self) -> Mapping[str, object]:
        """What the log says of it: its name, format, rate."""
        ...

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the newest image, or None when there is none within the time.

        Raises
        ------
        CaptureError
            When the camera is gone or has failed.
        DamagedImageError
            When what came is not a whole image.
        """
        ...

    def close(self) -> None:
        """Give the camera back. Images that are still looked at stay as they are."""
        ...


def nothing_to_give_back() -> None:
    """Do nothing: the image has memory of its own."""
