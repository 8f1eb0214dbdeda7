"""A GStreamer pipeline in a process of its own: what crashes there crashes nothing here, and no binding is needed."""

from __future__ import annotations

import contextlib
import os
import select
import shlex
import shutil
import subprocess
import time
import zlib
from collections.abc import Mapping
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from companion.errors import SourceError
from companion.frames.capture import CapturedImage, CaptureError, nothing_to_give_back

_PROGRAM: Final = "gst-launch-1.0"
_LAST_WORDS: Final = 2_000
_GONE_S: Final = 1.0


def gstreamer_command(pipeline: str, width_px: int, height_px: int) -> list[str]:
    """Return the command that writes a pipeline's grey frames to its standard output, newest first.

    Raises
    ------
    companion.errors.SourceError
        When GStreamer is not installed, the size is not given, or the pipeline cannot be read.
    """
    program = shutil.which(_PROGRAM)
    if program is None:
        raise SourceError(
            f"gst: needs {_PROGRAM}, which is not installed: "
            "apt install gstreamer1.0-tools gstreamer1.0-plugins-base gstreamer1.0-plugins-good"
        )
    if not width_px:
        raise SourceError(
            "gst: needs source.width_px and source.height_px: the size that the pipeline delivers"
        )
    try:
        words = shlex.split(pipeline)
    except ValueError as error:
        raise SourceError(f"gst: the pipeline cannot be read: {error}") from error
    caps = f"video/x-raw,format=GRAY8,width={width_px},height={height_px}"
    # The leaky queue holds one frame: one that nobody fetched is replaced by the next.
    queue = ["queue", "leaky=downstream", "max-size-buffers=1", "max-size-bytes=0", "max-size-time=0"]
    return [program, "-q", *words, "!", "videoconvert", "!", caps, "!", *queue, "!", "fdsink", "fd=1", "sync=false"]  # fmt: skip


class GstreamerCapture:
    """A running pipeline; satisfies ``companion.frames.capture.Capture``. Its frames have their time of arrival.

    Parameters
    ----------
    command
        Of :func:`gstreamer_command`.
    width_px, height_px
        Size of its frames.

    Raises
    ------
    companion.errors.SourceError
        When it cannot be started.
    """

    def __init__(self, command: list[str], width_px: int, height_px: int) -> None:
        self._size_px = (width_px, height_px)
        self._line_bytes = -4 * (-width_px // 4)  # GStreamer fills rows up to whole words
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,  # a terminal's Ctrl-C goes to the service alone
            )
        except OSError as error:
            raise SourceError(f"gst: cannot be started: {error.strerror or error}") from error
        self._frames = _opened(self._process.stdout)
        self._words = _opened(self._process.stderr)
        self._last_words = b""
        self._frame = self._empty()
        self._filled = 0

    @property
    def facts(self) -> Mapping[str, object]:
        """What the log says of it."""
        return {"pid": self._process.pid}

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the next image, or None when it is not complete within the time.

        Raises
        ------
        companion.frames.capture.CaptureError
            When the pipeline has ended; with its last words.
        """
        until_s = time.monotonic() + timeout_s
        view = memoryview(self._frame.reshape(-1).data)
        while self._filled < len(view):
            ready, _, _ = select.select(
                [self._frames, self._words], [], [], max(0.0, until_s - time.monotonic())
            )
            if not ready:
                return None
            if self._words in ready:
                self._last_words = (self._last_words + os.read(self._words.fileno(), 4096))[-_LAST_WORDS:]
            if self._frames in ready:
                received = os.readv(self._frames.fileno(), [view[self._filled :]])
                if received == 0:
                    raise CaptureError(self._why_it_ended())
                self._filled += received
            elif time.monotonic() >= until_s:
                return None
        frame, self._frame, self._filled = self._frame, self._empty(), 0
        return CapturedImage(
            frame[:, : self._size_px[0]], None, zlib.crc32(frame.data), 0, nothing_to_give_back
        )

    def close(self) -> None:
        """End the process and wait until it is gone."""
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # in a driver's call; it dies when that ends
            self._process.wait(_GONE_S)
        self._frames.close()
        self._words.close()

    def _empty(self) -> NDArray[np.uint8]:
        return np.empty((self._size_px[1], self._line_bytes), dtype=np.uint8)

    def _why_it_ended(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_GONE_S)
        while select.select([self._words], [], [], 0.0)[0] and (more := os.read(self._words.fileno(), 4096)):
            self._last_words = (self._last_words + more)[-_LAST_WORDS:]
        lines = self._last_words.decode("utf-8", "replace").splitlines()
        errors = [line.strip() for line in lines if "ERROR" in line] or [
            line.strip() for line in lines if line.strip()
        ]
        return f"the pipeline has ended: {errors[0] if errors else f'exit status {self._process.returncode}'}"


def _opened(pipe: IO[bytes] | None) -> IO[bytes]:
    if pipe is None:
        raise RuntimeError("started without a pipe")
    return pipe
