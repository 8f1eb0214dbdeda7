"""Errors that a caller could handle, one class a situation. The message says what to do about it."""

from __future__ import annotations


class CompanionError(Exception):
    """Base of all errors of the service. ``companion`` prints the message and exits with 1, without a traceback."""


class ConfigError(CompanionError):
    """A configuration file cannot be used: names the file, the key, what was found and what is allowed."""


class SourceError(CompanionError):
    """A frame source cannot be opened or has failed."""


class LinkError(CompanionError):
    """A MAVLink endpoint cannot be opened (port in use, unknown host)."""


class WorkerError(CompanionError):
    """The vision worker cannot be started."""


def first_of(group: BaseExceptionGroup[CompanionError]) -> CompanionError:
    """Return the first error of a group, or of a group of groups, as a TaskGroup raises them."""
    error: BaseException = group
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    if not isinstance(error, CompanionError):
        raise error
    return error
