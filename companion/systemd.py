"""What the service tells systemd: that it is ready, what it is doing, and that it still works (sd_notify).

The protocol is one datagram of ``NAME=value`` lines to the socket that the environment names; see sd_notify(3). A unit
of ``Type=notify`` counts as started with ``READY=1``, and one with ``WatchdogSec=`` is killed and started again when
``WATCHDOG=1`` stays away.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import MutableMapping
from typing import Final

from companion.errors import CompanionError

_FEEDS_A_PERIOD: Final = 4
"""WATCHDOG=1 is due twice in its period at the least (sd_watchdog_enabled(3)); a loaded machine may miss one."""
_STATUS_PERIOD_NS: Final = 1_000_000_000
_LONGEST_STATUS: Final = 200


class NotifySocketError(CompanionError):
    """The environment names a notify socket that cannot be used."""


class ServiceNotifier:
    """Tells systemd how the service is; says nothing where nobody listens.

    Never blocks and never raises once it is made: a manager that does not read must not stop setpoints. What cannot be
    sent at once is lost, and said again by the next call where that matters (the watchdog).

    Parameters
    ----------
    address
        Path of the datagram socket, or ``@name`` in the abstract namespace. None: nobody listens.
    watchdog_ns
        The unit's ``WatchdogSec``; None: it has none.

    Raises
    ------
    NotifySocketError
        When the address is not one.
    """

    def __init__(self, address: str | None, *, watchdog_ns: int | None = None) -> None:
        self._socket: socket.socket | None = None
        self._watchdog_ns = watchdog_ns
        self._status = ""
        self._is_ready = False
        if address is None:
            return
        if not address.startswith(("/", "@")):
            raise NotifySocketError(
                f"NOTIFY_SOCKET: found {address!r}; allowed: a path from the root, or @name"
            )
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str] = os.environ) -> ServiceNotifier:
        """Return a notifier for the manager that started this process, if one did.

        Takes its variables out of the environment: what this process starts is not the service, and must not speak for it.

        Raises
        ------
        NotifySocketError
            When the variables are there and are not what systemd sets.
        """
        address = environment.pop("NOTIFY_SOCKET", None) or None
        period_us = environment.pop("WATCHDOG_USEC", "")
        for_pid = environment.pop("WATCHDOG_PID", "")
        if not period_us or for_pid not in ("", str(os.getpid())):
            return cls(address)
        if not (period_us.isascii() and period_us.isdecimal()) or int(period_us) == 0:
            raise NotifySocketError(
                f"WATCHDOG_USEC: found {period_us!r}; allowed: whole microseconds above 0"
            )
        return cls(address, watchdog_ns=int(period_us) * 1000)

    @property
    def enabled(self) -> bool:
        """Whether anybody listens."""
        return self._socket is not None

    @property
    def period_ns(self) -> int:
        """How often :meth:`working` is to be called."""
        if self._watchdog_ns is None:
            return _STATUS_PERIOD_NS
        return min(_STATUS_PERIOD_NS, self._watchdog_ns // _FEEDS_A_PERIOD)

    def ready(self) -> None:
        """Say that the service does its work from now on."""
        self._is_ready = True
        self._send("READY=1")

    def working(self, status: str) -> None:
        """Feed the watchdog; say what the service is doing, in one line for ``systemctl status``."""
        line = " ".join(status.split())[:_LONGEST_STATUS]
        news = [] if line == self._status else [f"STATUS={line}"]
        if self._watchdog_ns is not None:
            news.append("WATCHDOG=1")
        if news and self._send(*news):
            self._status = line

    def reloading(self, now_ns: int) -> None:
        """Say that the configuration is being read again; :meth:`reloaded` ends that. Before :meth:`ready` it says nothing.

        Parameters
        ----------
        now_ns
            CLOCK_MONOTONIC: a unit of ``Type=notify-reload`` tells by it which request is answered.
        """
        if self._is_ready:
            self._send("RELOADING=1", f"MONOTONIC_USEC={now_ns // 1000}")

    def reloaded(self) -> None:
        """Say that the configuration has been read again, to whatever end. Before :meth:`ready` it says nothing."""
        if self._is_ready:
            self._send("READY=1")

    def stopping(self) -> None:
        """Say that the service is ending on purpose."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> bool:
        """Send one datagram; return whether it left."""
        if self._socket is None:
            return False
        with contextlib.suppress(OSError):  # full, or the manager is being started anew; see the class
            self._socket.sendto("\n".join(lines).encode(), self._address)
            return True
        return False
