"""What the worker process runs: frames in, reports out."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Protocol, cast, runtime_checkable

from numpy.typing import NDArray

from companion.config import CameraConfig, DetectorConfig
from companion.errors import ConfigError
from companion.frames.source import Frame
from companion.guidance.observation import DetectionReport, Pose

VOID_PIPELINE = "companion.vision.child:build_pipeline"
"""The detector itself."""


class Pipeline(Protocol):
    """Turns frames into reports, one at a time, in the order they come."""

    def detect(self, frame: Frame, pose: Pose | None) -> DetectionReport:
        """Return the report on one frame; ``frame_seq``, ``frame_ns`` and ``pose`` are echoed.

        An exception is reported with its traceback and ends the process.
        """
        ...


@runtime_checkable
class WithIdleWork(Protocol):
    """A pipeline that prepares for the next frame while the last report is already on its way."""

    def between_frames(self) -> None:
        """Do so; called after each report. An exception is reported and ends the process."""
        ...


@runtime_checkable
class WithDetails(Protocol):
    """A pipeline that can tell what it saw on the way to its last report."""

    def details(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return plain values and arrays by name; called behind the report, where somebody wants to know."""
        ...


PipelineFactory = Callable[[DetectorConfig, CameraConfig], Pipeline]
"""Builds a pipeline; raises ``companion.errors.ConfigError`` when the configuration cannot be used."""


def load_factory(name: str) -> PipelineFactory:
    """Return the factory of a name in the form ``package.module:function``.

    Raises
    ------
    companion.errors.ConfigError
        When there is none.
    """
    module_name, _, function_name = name.partition(":")
    try:
        factory = getattr(importlib.import_module(module_name), function_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise  # it is there, and something that it needs is not: a broken installation
        raise ConfigError(f"pipeline {name!r} cannot be found: {error}") from error
    except (AttributeError, ValueError) as error:
        raise ConfigError(f"pipeline {name!r} cannot be found: {error}") from error
    return cast("PipelineFactory", factory)
