"""Endpoints by URL."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from companion.config.endpoint_url import parse_endpoint_url
from companion.errors import LinkError
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.link import UdpEndpoint
from companion.mavlink.network import side_names


def make_endpoint(
    url: str,
    *,
    name: str = "link",
    now_ns: Callable[[], int] = time.monotonic_ns,
    late_after_s: float | None = None,
) -> Endpoint:
    """Return the endpoint that a URL names; ``async with`` opens it.

    Parameters
    ----------
    url
        ``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT``, ``tcpin:HOST:PORT`` or ``serial:DEVICE:BAUD``.
    name
        How status and errors call it.
    now_ns
        Monotonic time.
    late_after_s
        As of `UdpEndpoint`; the kernel keeps no such time for TCP and serial lines.

    Raises
    ------
    LinkError
        When the URL cannot be read.
    """
    try:
        kind = parse_endpoint_url(url).kind
    except ValueError as error:
        raise LinkError(f"{name}: cannot read {url!r}; expected {error}") from error
    match kind:
        case "udpin" | "udpout":
            return UdpEndpoint(url, name=name, now_ns=now_ns, late_after_s=late_after_s)
        case "tcp":
            from companion.mavlink.tcp import TcpEndpoint

            return TcpEndpoint(url, name=name)
        case "tcpin":
            from companion.mavlink.tcp import TcpServerEndpoint

            return TcpServerEndpoint(url, name=name)
        case "serial":
            from companion.mavlink.serial_line import SerialEndpoint

            return SerialEndpoint(url, name=name)


def make_side(
    side: str,
    urls: Sequence[str],
    *,
    now_ns: Callable[[], int] = time.monotonic_ns,
    late_after_s: float | None = None,
) -> tuple[Endpoint, ...]:
    """Return the endpoints of one side, ``planner`` or ``autopilot``, named as the filters name them.

    Raises
    ------
    LinkError
        When a URL cannot be read.
    """
    names = side_names(side, len(urls))
    return tuple(
        make_endpoint(url, name=f"link.{name}", now_ns=now_ns, late_after_s=late_after_s)
        for url, name in zip(urls, names, strict=True)
    )
