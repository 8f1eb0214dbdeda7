"""What a search can end with."""

from __future__ import annotations

from companion.errors import CompanionError


class TuneError(CompanionError):
    """A search cannot be made as it was asked for; the message is one line."""


class TrialError(CompanionError):
    """One trial could not be judged: its settings do not go together, or its simulation failed. The search goes on."""
