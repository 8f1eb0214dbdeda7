"""The index of a recording's chunks while it is being written: as the bytes that end up in the file.

The library keeps an object of about a kilobyte for each chunk until the file ends: 8 MiB after a quarter of an hour of 640 x 480 at
10 Hz. Packed, it is a hundred and some bytes a chunk.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Protocol

from mcap.data_stream import RecordBuilder
from mcap.writer import Writer

_ATTRIBUTE: Final = "_Writer__chunk_indices"
"""Where mcap 1 keeps the index. It has no public place for it; where another version has it elsewhere, only memory is lost."""


class Record(Protocol):
    """Something that can be written into a file."""

    def write(self, stream: RecordBuilder) -> object:
        """Write it."""
        ...


class PackedIndex:
    """Takes the place of a list of ``mcap.records.ChunkIndex``, for appending and for going through it."""

    def __init__(self) -> None:
        self._packed = bytearray()

    def append(self, record: Record) -> None:
        """Take a record as it is now."""
        builder = RecordBuilder()
        record.write(builder)
        self._packed += builder.end()  # type: ignore[no-untyped-call]  # the library has it without a type

    def __iter__(self) -> Iterator[Record]:
        """Yield what writes all records, as one."""
        yield _Packed(self._packed)


class _Packed:
    def __init__(self, data: bytearray) -> None:
        self._data = data

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._data)


def pack_index_of(writer: Writer) -> None:
    """Have a writer that has written no chunk yet keep its index packed."""
    setattr(writer, _ATTRIBUTE, PackedIndex())
