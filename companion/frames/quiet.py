"""Keeps OpenCV and FFmpeg from writing their own lines beside the service's log, which is JSON on the same stream."""

from __future__ import annotations

import os

import cv2

_FFMPEG_QUIET = "-8"  # AV_LOG_QUIET
_OPENCV_SILENT = 0


def quieten_decoders() -> None:
    """Silence both, unless the environment asks for their messages; what goes wrong is said in the log by its source.

    OpenCV takes FFmpeg's level from the environment when it first uses it.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _FFMPEG_QUIET)
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(_OPENCV_SILENT)
