"""Which of a camera's formats and sizes to ask for. Pure."""

from __future__ import annotations

from companion.errors import SourceError
from companion.frames.v4l2.device import ActiveFormat, FrameSize, PixelFormat
from companion.frames.v4l2.pixels import READABLE

_ENOUGH_HZ = 20.0
"""A cheaper format is taken as long as it comes at this rate, where no rate is asked for."""
_RATE_SLACK = 0.98
"""29.97 Hz is the 30 Hz that was asked for."""


def choose_format(
    formats: tuple[PixelFormat, ...],
    active: ActiveFormat,
    *,
    name: str,
    width_px: int,
    height_px: int,
    rate_hz: float,
    path: str,
) -> ActiveFormat:
    """Return the format to ask the driver for.

    Parameters
    ----------
    formats
        What the camera offers.
    active
        What it is set to, which holds for what is not asked for.
    name
        Four letters of the pixel format; "": the cheapest one that has the size, at the rate.
    width_px, height_px
        Size; 0: as it is set.
    rate_hz
        Frame rate; 0: any that is fast enough.
    path
        The camera's name in messages.

    Raises
    ------
    companion.errors.SourceError
        When the camera has no such format or size; says what it has.
    """
    readable = sorted((f for f in formats if f.name in READABLE), key=lambda f: READABLE.index(f.name))
    if not readable:
        offered = ", ".join(f.name for f in formats) or "none"
        raise SourceError(
            f"{path}: no pixel format that is understood: found {offered}; understood: {', '.join(READABLE)}"
        )
    if name and name not in [f.name for f in readable]:
        raise SourceError(
            f"{path}: no pixel format {name}; this camera has {', '.join(f.name for f in readable)}"
        )
    wanted = [f for f in readable if f.name == name] if name else readable
    width_px, height_px = (width_px, height_px) if width_px else (active.width_px, active.height_px)
    fitting = [(f, size) for f in wanted if (size := _size_of(f, width_px, height_px)) is not None]
    if not fitting:
        sizes = sorted({(s.width_px, s.height_px) for f in wanted for s in f.sizes})
        raise SourceError(
            f"{path}: no size of {width_px} x {height_px} px in {', '.join(f.name for f in wanted)}; "
            f"this camera has {', '.join(f'{w} x {h}' for w, h in sizes) or 'none'}"
        )
    enough_hz = rate_hz * _RATE_SLACK if rate_hz else _ENOUGH_HZ
    best, _ = next(
        ((f, size) for f, size in fitting if not size.rates_hz or max(size.rates_hz) >= enough_hz),
        max(fitting, key=lambda pair: max(pair[1].rates_hz, default=0.0)),
    )
    return ActiveFormat(best.name, width_px, height_px, 0)


def _size_of(pixel_format: PixelFormat, width_px: int, height_px: int) -> FrameSize | None:
    """Return the entry that has a size; a driver that lists none may have any."""
    if not pixel_format.sizes:
        return FrameSize(width_px, height_px, None, ())
    for size in pixel_format.sizes:
        if (size.width_px, size.height_px) == (width_px, height_px):
            return size
        least = size.least_px
        if (
            least is not None
            and least[0] <= width_px <= size.width_px
            and least[1] <= height_px <= size.height_px
        ):
            return size
    return None
