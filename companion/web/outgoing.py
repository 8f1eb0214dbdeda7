"""What waits for one viewer: bounded whatever it does, the newest wins (pure)."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any, Final

from companion.web.state import KEPT, Increment

_PICTURES_ON_THE_WAY: Final = 2
"""Pictures sent and not yet shown: one on the wire while one is drawn. More would only be older when they come."""


class Outgoing:
    """Increments of the state that were not sent yet, merged, and the newest picture.

    A viewer that takes nothing keeps at most one picture, one value of each name, and the newest entries of each list.
    """

    def __init__(self) -> None:
        self._latest: dict[str, Any] = {}
        self._appended: dict[str, deque[Any]] = {}
        self._missed: Counter[str] = Counter()
        self._picture: bytes | None = None
        self._on_the_way = 0
        self._snapshot: Increment | None = None
        self.pictures_replaced = 0
        """Pictures that a newer one took the place of."""

    def begin(self, snapshot: Increment) -> None:
        """Begin with all that is known, in place of whatever waits."""
        self._latest.clear()
        self._appended.clear()
        self._missed.clear()
        self._snapshot = snapshot

    def add(self, increment: Increment) -> None:
        """Add what is new."""
        self._latest.update(increment.latest)
        for name, entries in increment.appended.items():
            waiting = self._appended.setdefault(name, deque(maxlen=KEPT[name]))
            self._missed[name] += max(0, len(waiting) + len(entries) - KEPT[name])
            waiting.extend(entries)

    def add_picture(self, picture: bytes) -> None:
        """Put a picture in the place of the one that waits."""
        if self._picture is not None:
            self.pictures_replaced += 1
        self._picture = picture

    def shown(self) -> None:
        """Note that the viewer has drawn a picture: there is room on the way for another."""
        self._on_the_way = max(0, self._on_the_way - 1)

    def has_any(self) -> bool:
        """Return whether there is something to send now."""
        return bool(
            self._snapshot is not None
            or self._latest
            or self._appended
            or (self._picture is not None and self._on_the_way < _PICTURES_ON_THE_WAY)
        )

    def take(self) -> tuple[dict[str, Any] | None, bytes | None]:
        """Return a message and a picture to send now, either of them None where there is none."""
        message: dict[str, Any] | None = None
        if self._snapshot is not None:
            message = {
                "type": "snapshot",
                "latest": self._snapshot.latest,
                "appended": self._snapshot.appended,
            }
            self._snapshot = None
        elif self._latest or self._appended:
            message = {
                "type": "update",
                "latest": self._latest,
                "appended": {name: list(entries) for name, entries in self._appended.items()},
            }
            if missed := {name: count for name, count in self._missed.items() if count}:
                message["missed"] = missed
            self._latest, self._appended = {}, {}
            self._missed.clear()
        picture: bytes | None = None
        if self._picture is not None and self._on_the_way < _PICTURES_ON_THE_WAY:
            picture, self._picture = self._picture, None
            self._on_the_way += 1
        return message, picture
