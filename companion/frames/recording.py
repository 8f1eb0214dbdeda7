"""Recordings as a sequence of grey images with times: a video file, or a folder of images."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import SourceError

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".pnm", ".tif", ".tiff", ".webp"}
)
TIMESTAMPS_NAME = "timestamps.csv"


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """One image of a recording.

    Attributes
    ----------
    offset_ns
        Time since the recording's first image.
    image
        (H, W) uint8, or None where it cannot be decoded.
    """

    offset_ns: int
    image: NDArray[np.uint8] | None


class Recording(Protocol):
    """A recording that is played once, from its beginning. Used by one thread."""

    def skip_until(self, offset_ns: int) -> int:
        """Pass over images that have a successor due by ``offset_ns``; return how many."""
        ...

    def read(self) -> RecordedImage | None:
        """Return the next image, or None at the end."""
        ...

    def next_offset_ns(self) -> int | None:
        """Return when the next image is due, or None at the end; estimated where only reading would tell."""
        ...

    @property
    def missing(self) -> int:
        """Images that the recording promised and, at its end, did not have."""
        ...

    @property
    def interval_ns(self) -> int:
        """The nominal time between two images; from the last image to the first one of the next round."""
        ...

    def rewind(self) -> None:
        """Start again at the beginning."""
        ...

    def close(self) -> None:
        """Give back what the recording holds."""
        ...


def open_recording(path: Path, fps_hz: float) -> Recording:
    """Open a video file or a folder of images.

    Parameters
    ----------
    path
        The file or folder.
    fps_hz
        Frame rate where the recording does not say.

    Raises
    ------
    companion.errors.SourceError
        When there is nothing that can be played; names the path and says why.
    """
    try:
        if path.is_dir():
            return ImageFolder(path, fps_hz)
        if path.is_file():
            return VideoFile(path, fps_hz)
        exists = path.exists()
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    if exists:
        raise SourceError(f"{path}: neither a video file nor a folder of images")
    raise SourceError(f"{path}: no such file or folder")


class ImageFolder:
    """Images of a folder in natural order of their names, at the times of ``timestamps.csv``, else at ``fps_hz``.

    ``timestamps.csv`` has a header line with the columns ``file`` and ``time_s``; the times increase. Only
    the images that it lists are played.
    """

    def __init__(self, folder: Path, fps_hz: float) -> None:
        self._folder = folder
        self._interval_ns = round(1e9 / fps_hz)
        table = folder / TIMESTAMPS_NAME
        if table.is_file():
            self._names, times_s = _read_timestamps(table)
            self._offsets_ns = [round((time_s - times_s[0]) * 1e9) for time_s in times_s]
            if len(times_s) > 1:
                self._interval_ns = round(float(np.median(np.diff(self._offsets_ns))))
        else:
            found = (p.name for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
            self._names = sorted(found, key=natural_key)
            self._offsets_ns = [i * self._interval_ns for i in range(len(self._names))]
        if not self._names:
            raise SourceError(f"{folder}: no images in this folder ({', '.join(sorted(IMAGE_SUFFIXES))})")
        if not any((folder / name).is_file() for name in self._names):
            raise SourceError(f"{table}: none of the {len(self._names)} listed images exists")
        self._at = 0

    @property
    def offsets_ns(self) -> tuple[int, ...]:
        """Time of each image since the first."""
        return tuple(self._offsets_ns)

    def skip_until(self, offset_ns: int) -> int:
        """Pass over images that have a successor due by ``offset_ns``; return how many."""
        before = self._at
        while self._at + 1 < len(self._names) and self._offsets_ns[self._at + 1] <= offset_ns:
            self._at += 1
        return self._at - before

    def read(self) -> RecordedImage | None:
        """Return the next image, or None at the end."""
        if self._at >= len(self._names):
            return None
        image = _read_grey(self._folder / self._names[self._at])
        self._at += 1
        return RecordedImage(self._offsets_ns[self._at - 1], image)

    def next_offset_ns(self) -> int | None:
        """Return when the next image is due, or None at the end."""
        return self._offsets_ns[self._at] if self._at < len(self._names) else None

    @property
    def missing(self) -> int:
        """Always 0: each missing file is met as an undecodable image."""
        return 0

    @property
    def interval_ns(self) -> int:
        """The median time between two images."""
        return self._interval_ns

    def rewind(self) -> None:
        """Start again at the beginning."""
        self._at = 0

    def close(self) -> None:
        """Nothing is held."""


class VideoFile:
    """A video file, decoded by OpenCV; times are the container's where they increase, else by frame rate."""

    def __init__(self, path: Path, fps_hz: float) -> None:
        self._path = path
        self._capture = self._open()
        stated_hz = self._capture.get(cv2.CAP_PROP_FPS)
        rate_hz = stated_hz if math.isfinite(stated_hz) and 0 < stated_hz <= 1000 else fps_hz
        self._interval_ns = round(1e9 / rate_hz)
        stated_frames = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self._stated_frames = int(stated_frames) if 0 < stated_frames < 1e9 else 0
        self._grabbed = 0
        self._first_stamp_ns = 0
        self._last_offset_ns: int | None = None
        self._ended = False

    def skip_until(self, offset_ns: int) -> int:
        """Pass over frames that have a successor due by ``offset_ns``; return how many.

        The successor's time is estimated from the frame rate. Skipping decodes but does not convert.
        """
        skipped = 0
        while (next_ns := self.next_offset_ns()) is not None and next_ns + self._interval_ns <= offset_ns:
            if not self._grab():
                break
            skipped += 1
        return skipped

    def read(self) -> RecordedImage | None:
        """Return the next frame, or None at the end of what can be decoded."""
        if self._ended or not self._grab() or self._last_offset_ns is None:
            return None
        return RecordedImage(self._last_offset_ns, self._retrieve())

    def next_offset_ns(self) -> int | None:
        """Return when the next frame is due by the frame rate, or None after the end."""
        if self._ended:
            return None
        return 0 if self._last_offset_ns is None else self._last_offset_ns + self._interval_ns

    @property
    def missing(self) -> int:
        """Frames short of the container's own count, after the end; more than rounding explains."""
        short = self._stated_frames - self._grabbed
        return short if self._ended and short > 1 + 0.02 * self._stated_frames else 0

    @property
    def interval_ns(self) -> int:
        """The time between two frames by the container's frame rate."""
        return self._interval_ns

    def rewind(self) -> None:
        """Start again at the beginning. Opened anew: not every container can seek."""
        self._capture.release()
        self._capture = self._open()
        self._last_offset_ns = None
        self._grabbed = 0
        self._ended = False

    def close(self) -> None:
        """Release the decoder."""
        self._capture.release()

    def _open(self) -> cv2.VideoCapture:
        # FFmpeg where OpenCV has it: the other back ends take any file for a pattern of images.
        backends = cv2.videoio_registry.getBackends()
        backend = cv2.CAP_FFMPEG if cv2.CAP_FFMPEG in backends else cv2.CAP_ANY
        try:
            capture = cv2.VideoCapture(str(self._path), backend)
        except cv2.error as error:
            raise SourceError(f"{self._path}: not a video that OpenCV can decode: {error.err}") from error
        if not capture.isOpened():
            raise SourceError(f"{self._path}: not a video that OpenCV can decode, or damaged")
        return capture

    def _grab(self) -> bool:
        try:
            grabbed = self._capture.grab()
        except cv2.error:
            grabbed = False
        if not grabbed:
            self._ended = True
            return False
        self._grabbed += 1
        stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        stamp_ns = round(stamp_ms * 1e6) if math.isfinite(stamp_ms) else 0
        if self._last_offset_ns is None:
            self._first_stamp_ns = stamp_ns
            self._last_offset_ns = 0
            return True
        offset_ns = stamp_ns - self._first_stamp_ns
        # A stamp that stands still or leaps belongs to a damaged or stampless file.
        plausible = self._last_offset_ns < offset_ns <= self._last_offset_ns + 1_000 * self._interval_ns
        self._last_offset_ns = offset_ns if plausible else self._last_offset_ns + self._interval_ns
        return True

    def _retrieve(self) -> NDArray[np.uint8] | None:
        try:
            decoded, image = self._capture.retrieve()
            if not decoded or image is None or image.size == 0:
                return None
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        except cv2.error:
            return None
        return np.ascontiguousarray(grey, dtype=np.uint8)


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders ``frame2`` before ``frame10``."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part)


def _read_grey(path: Path) -> NDArray[np.uint8] | None:
    try:
        # A name in timestamps.csv may be that of a pipe, and opening one waits for somebody to write into it.
        data = np.fromfile(path, dtype=np.uint8) if path.is_file() else np.empty(0, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    except (OSError, cv2.error):
        return None
    return None if image is None or image.size == 0 else np.asarray(image, dtype=np.uint8)


def _read_timestamps(path: Path) -> tuple[list[str], list[float]]:
    names: list[str] = []
    times_s: list[float] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, strict=True, skipinitialspace=True)
            if rows.fieldnames is None or not {"file", "time_s"} <= set(rows.fieldnames):
                found = ", ".join(rows.fieldnames or ["nothing"])
                raise SourceError(f"{path}: line 1: found columns {found}; needed: file, time_s")
            for row in rows:
                name, time_s = row["file"], _number(row["time_s"])
                where = f"{path}: line {rows.line_num}"
                if not name or Path(name).is_absolute() or ".." in Path(name).parts:
                    raise SourceError(f"{where}: found file {name!r}; allowed: a name inside this folder")
                if time_s is None:
                    raise SourceError(f"{where}: found time_s {row['time_s']!r}; allowed: a number")
                if times_s and time_s <= times_s[-1]:
                    raise SourceError(f"{where}: time_s {time_s} does not come after {times_s[-1]}")
                names.append(name)
                times_s.append(time_s)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    if not names:
        raise SourceError(f"{path}: lists no images")
    return names, times_s


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) < 1e11 else None  # 1e11 s: times since 1970 fit
