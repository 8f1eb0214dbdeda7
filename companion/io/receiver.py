"""Packets of the feed as messages with their pixels: the I/O process's side of the socket."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from companion.io.frame_ring import MappedRing
from companion.io.messages import Kind, Message, unpack


class Receiver:
    """Makes messages of packets; keeps the frames' memory mapped."""

    def __init__(self) -> None:
        self._ring: MappedRing | None = None
        self.lost_frames = 0
        """Frames that were overwritten before they could be read."""

    def messages(self, packet: bytes, fds: Sequence[int] = ()) -> Iterator[Message]:
        """Yield what a packet holds; frames come with their image.

        Parameters
        ----------
        packet
            As the feed made it.
        fds
            The descriptors that came with it; they are closed here.

        Raises
        ------
        companion.io.messages.PacketError
            When it is none of the feed's.
        """
        for message in unpack(packet):
            if message.kind is Kind.RING:
                self.close()
                self._ring = MappedRing(fds[0], message.fields["frame_bytes"])
            elif message.kind is Kind.FRAME:
                with_image = self._with_image(message)
                if with_image is None:
                    self.lost_frames += 1
                else:
                    yield with_image
            else:
                yield message

    def close(self) -> None:
        """Unmap the memory."""
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    def _with_image(self, message: Message) -> Message | None:
        if self._ring is None:
            return None
        fields = message.fields
        image = self._ring.read(fields["number"], fields["height_px"], fields["width_px"])
        return None if image is None else replace(message, image=image)
