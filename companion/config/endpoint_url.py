"""Endpoints as text: ``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT``, ``tcpin:HOST:PORT``, ``serial:DEVICE:BAUD`` (pure)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Kind = Literal["udpin", "udpout", "tcp", "tcpin", "serial"]

_FORMS: Final = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:/dev/NAME:BAUD"
_LISTENING: Final = ("udpin", "tcpin")
_MOST_BAUD: Final = 12_000_000


@dataclass(frozen=True, slots=True)
class EndpointUrl:
    """One endpoint.

    Attributes
    ----------
    kind
        How it is reached. ``udpin`` and ``tcpin`` listen, the others call.
    where
        Host, or the path of a serial device.
    number
        Port, or the baud rate of a serial device.
    """

    kind: Kind
    where: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.where}:{self.number}"

    @property
    def listens(self) -> bool:
        """Whether others call here."""
        return self.kind in _LISTENING

    @property
    def may_repeat(self) -> bool:
        """Whether two endpoints may have this URL: each gets a free port of its own."""
        return self.listens and self.number == 0


def parse_endpoint_url(text: str) -> EndpointUrl:
    """Read an endpoint.

    Raises
    ------
    ValueError
        Saying what is allowed.
    """
    scheme, _, rest = text.partition(":")
    where, _, digits = rest.rpartition(":")
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) <= 8 else -1
    match scheme:
        case "serial":
            if not where.startswith("/") or number < 0:
                raise ValueError("serial:/dev/serial/by-id/NAME:BAUD")
            if not 1200 <= number <= _MOST_BAUD:
                raise ValueError(f"a baud rate from 1200 to {_MOST_BAUD}")
            return EndpointUrl("serial", where, number)
        case "udpin" | "udpout" | "tcp" | "tcpin":
            if not where or ":" in where or number < 0:
                raise ValueError(_FORMS)
            least = 0 if scheme in _LISTENING else 1
            if not least <= number <= 65535:
                raise ValueError(
                    f"a port from {least} to 65535" + (" (0: any free one)" if least == 0 else "")
                )
            return EndpointUrl(scheme, where, number)
    raise ValueError(_FORMS)
