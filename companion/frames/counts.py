"""What became of the frames that a source met: every loss has a name and a number."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class FrameCounts:
    """Counters of one source, for status lines. Only ever grow.

    Attributes
    ----------
    delivered
        Frames given to the consumer.
    skipped_late
        Replaced by a newer one before the consumer came for them.
    undecodable
        Images that could not be read or decoded.
    wrong_size
        Images of another size than the first one.
    time_refused
        Exposure times in the future, too far in the past, or not after the one before.
    reconnects
        Times that a connection was made, or a camera opened, again.
    repeated
        Pictures that were the one before again, bit for bit.
    lost_by_driver
        Frames that a camera's driver or a stream's decoder dropped because nobody fetched them in time.
    """

    delivered: int = 0
    skipped_late: int = 0
    undecodable: int = 0
    wrong_size: int = 0
    time_refused: int = 0
    reconnects: int = 0
    repeated: int = 0
    lost_by_driver: int = 0
