"""What a child process writes to its standard output and error, line by line."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable
from typing import Final

from companion.children.process import ChildProcess

_LONGEST_LINE: Final = 1000
_MOST_LINES: Final = 50
"""A library that warns with every frame must not fill the log."""
_LAST_LINES: Final = 10


class OutputLines:
    """Takes a child's output as it comes, and keeps its last words.

    Parameters
    ----------
    on_line
        Takes each of the first 50 lines.
    """

    def __init__(self, on_line: Callable[[str], None]) -> None:
        self._on_line = on_line
        self._left = _MOST_LINES
        self._begun = b""
        self._last: deque[str] = deque(maxlen=_LAST_LINES)

    @property
    def last_words(self) -> str:
        """The last ten lines."""
        return "\n".join(self._last)

    def read_from(self, process: ChildProcess) -> None:
        """Take what there is now; at the end of it the running event loop no longer looks at it. Never blocks."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            data = process.read_output()
            if not data:
                asyncio.get_running_loop().remove_reader(process.output_fd)
        *lines, rest = (self._begun + data).split(b"\n")
        self._begun = rest[-_LONGEST_LINE:]
        for line in lines:
            text = line[:_LONGEST_LINE].decode("utf-8", "backslashreplace").rstrip()
            self._last.append(text)
            if self._left > 0:
                self._left -= 1
                self._on_line(text)
