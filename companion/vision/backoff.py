"""How long to wait before the worker is started again. The budget delays restarts, it never ends them."""

from __future__ import annotations


class RestartBackoff:
    """Doubles the delay with each death; starts over after a worker that had lasted.

    Parameters
    ----------
    first_s
        Delay after the first death.
    longest_s
        Longest delay; a worker that has answered for this long counts as having lasted.
    """

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._next_s = first_s

    def delay_after_s(self, answered_for_s: float) -> float:
        """Return the delay after the death of a worker.

        Parameters
        ----------
        answered_for_s
            Time between its first and its last answer.
        """
        if answered_for_s >= self._longest_s:
            self._next_s = self._first_s
        delay_s = self._next_s
        self._next_s = min(2 * delay_s, self._longest_s)
        return delay_s
