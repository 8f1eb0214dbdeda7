"""A serial line of MAVLink: ``serial:/dev/serial/by-id/NAME:BAUD``."""

from __future__ import annotations

import errno
import termios
from typing import Final

import serial

from companion.config.endpoint_url import parse_endpoint_url
from companion.errors import LinkError
from companion.mavlink.caller import CallingEndpoint
from companion.mavlink.framing import MAX_FRAME_BYTES

_WAIT_S: Final = 0.1
"""What may wait for the line, in seconds of it: beyond that frames are dropped rather than late."""
_BITS_PER_BYTE: Final = 10
_REASONS: Final = {
    errno.ENOENT: "no such device",
    errno.EACCES: "not allowed; add this user to the group of the device (dialout)",
    errno.EBUSY: "another program has it open",
}


class SerialEndpoint(CallingEndpoint):
    """Keeps one serial device open: one that is unplugged, or comes back under another number, is opened again.

    Name the device by ``/dev/serial/by-id/...``: ``/dev/ttyACM0`` may be ``ttyACM1`` after the autopilot's reboot.

    Parameters
    ----------
    url
        ``serial:/dev/NAME:BAUD``. USB devices take any rate.
    name
        How errors call it.

    Raises
    ------
    LinkError
        When the URL cannot be read.
    """

    def __init__(self, url: str, *, name: str = "link") -> None:
        try:
            parsed = parse_endpoint_url(url)
        except ValueError as error:
            raise LinkError(f"{name}: cannot read {url!r}; expected {error}") from error
        if parsed.kind != "serial":
            raise LinkError(f"{name}: cannot read {url!r}; expected serial:/dev/serial/by-id/NAME:BAUD")
        waiting = max(2 * MAX_FRAME_BYTES, int(_WAIT_S * parsed.number / _BITS_PER_BYTE))
        super().__init__(url, name, max_waiting_bytes=waiting)
        self._device, self._baud = parsed.where, parsed.number
        self._port: serial.Serial | None = None

    async def _open(self) -> int:
        try:
            # Opened without waiting for a carrier, and locked: two readers of one line share its bytes between them.
            port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0, exclusive=True)
        except serial.SerialException as error:
            number = errno.EBUSY if "exclusively lock" in str(error) else error.errno
            raise OSError(number or errno.EIO, _REASONS.get(number or 0, str(error))) from error
        except ValueError as error:
            raise OSError(errno.EINVAL, f"{self._baud} baud: {error}") from error
        self._port = port
        fd = int(port.fileno())
        # An empty read then means a hang-up, and not that nothing is there at the moment.
        modes = termios.tcgetattr(fd)
        modes[6][termios.VMIN] = 1
        termios.tcsetattr(fd, termios.TCSANOW, modes)
        return fd

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()
