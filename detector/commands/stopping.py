"""Ctrl-C and SIGTERM while something is written: what is in hand is finished, and the file is closed."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Final

_SIGNALS: Final = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
"""With what does nobody else wait for them: a process that was told to ignore a signal goes on doing so."""
_EXIT_BY_SIGNAL: Final = 128


class StopRequest:
    """Whether a signal asked to stop, and which.

    Attributes
    ----------
    by
        The first of them; None while there was none.
    hurry
        Whether a second one raises KeyboardInterrupt at once; else it is only noted, as the first one always is.
    """

    def __init__(self) -> None:
        self.by: signal.Signals | None = None
        self.hurry = True

    @property
    def exit_code(self) -> int:
        """What a shell expects of a program that a signal ended: 130 for SIGINT, 143 for SIGTERM."""
        return _EXIT_BY_SIGNAL + (self.by or signal.SIGINT)

    def note(self, number: int, _frame: FrameType | None) -> None:
        """Take a signal."""
        if self.by is None:
            self.by = signal.Signals(number)
        elif self.hurry:
            raise KeyboardInterrupt


@contextlib.contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Catch SIGINT and SIGTERM inside the context, in the main thread; elsewhere nothing is caught."""
    request = StopRequest()
    before = {}
    if threading.current_thread() is threading.main_thread():  # a handler can be set there alone
        before = {number: usual for number, usual in _SIGNALS.items() if signal.getsignal(number) is usual}
    for number in before:
        signal.signal(number, request.note)
    try:
        yield request
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
