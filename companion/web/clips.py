"""Recordings picture by picture, in any order, with the poses that were recorded beside them. Used by one thread."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import SourceError
from companion.frames.quiet import quieten_decoders
from companion.frames.recording import IMAGE_SUFFIXES, TIMESTAMPS_NAME, ImageFolder, open_recording
from companion.guidance.observation import Pose
from companion.sim.recorded_poses import RecordedPoses

VIDEO_SUFFIXES: Final = frozenset({".mp4", ".mkv", ".webm", ".avi", ".mov", ".m4v", ".mjpeg", ".mjpg"})
MCAP_SUFFIX: Final = ".mcap"
_POSES_NAME: Final = "poses.csv"
_CAMERA_NAME: Final = "camera.toml"
_RATE_HZ: Final = 10.0
"""Of images whose recording does not say."""


class Clip(Protocol):
    """A recording of which any picture can be asked for.

    Attributes
    ----------
    times_ns
        Of each picture, from the first.
    camera_file
        That lies beside it; "" where there is none.
    has_poses
        Whether poses were recorded.
    """

    times_ns: list[int]
    camera_file: str
    has_poses: bool

    def picture(self, number: int) -> NDArray[np.uint8] | None:
        """Return a picture, (H, W) uint8; None where it cannot be decoded."""
        ...

    def pose(self, number: int) -> Pose | None:
        """Return the vehicle's pose at a picture's time, where it is known."""
        ...

    def close(self) -> None:
        """Give back what it holds."""
        ...


def kind_of(path: Path) -> str | None:
    """Return what a file or folder is as a recording, ``mcap``, ``video`` or ``images``; None: none."""
    suffix = path.suffix.lower()
    try:
        if path.is_file():
            return "mcap" if suffix == MCAP_SUFFIX else "video" if suffix in VIDEO_SUFFIXES else None
        if path.is_dir():
            if (path / TIMESTAMPS_NAME).is_file():
                return "images"
            if any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in path.iterdir()):
                return "images"
    except OSError:
        return None
    return None


def open_clip(path: Path) -> Clip:
    """Open a recording.

    Raises
    ------
    companion.errors.SourceError
        When there is nothing that can be shown.
    """
    quieten_decoders()
    match kind_of(path):
        case "images":
            return FolderClip(path)
        case "video":
            return VideoClip(path)
        case "mcap":
            from companion.web.mcap_clip import McapClip  # its library is not needed for others

            return McapClip(path)
        case _:
            raise SourceError(f"{path.name}: neither a recording nor a video nor a folder of images")


class FolderClip:
    """A folder of images."""

    def __init__(self, folder: Path) -> None:
        self._recording = ImageFolder(folder, _RATE_HZ)
        self.times_ns = list(self._recording.offsets_ns)
        camera = folder / _CAMERA_NAME
        self.camera_file = str(camera) if camera.is_file() else ""
        self._poses = _load_poses(folder / _POSES_NAME)
        self.has_poses = self._poses is not None

    def picture(self, number: int) -> NDArray[np.uint8] | None:
        """Return a picture, (H, W) uint8; None where it cannot be decoded."""
        self._recording.rewind()
        self._recording.skip_until(self.times_ns[number])
        found = self._recording.read()
        return None if found is None else found.image

    def pose(self, number: int) -> Pose | None:
        """Return the vehicle's pose at a picture's time, where it is known."""
        if self._poses is None:
            return None
        (north_m, east_m, down_m), attitude = self._poses.pose_at(self.times_ns[number] / 1e9)
        return Pose(self.times_ns[number], north_m, east_m, down_m, attitude)

    def close(self) -> None:
        """Nothing is held."""


class VideoClip:
    """A video file, decoded by OpenCV. Going back opens it anew: not every container can seek to an exact picture."""

    camera_file = ""
    has_poses = False

    def __init__(self, path: Path) -> None:
        self._path = path
        recording = open_recording(path, _RATE_HZ)  # says in words what is wrong with it
        try:
            count = recording.skip_until(1 << 62)
            interval_ns = recording.interval_ns
        finally:
            recording.close()
        if count == 0:
            raise SourceError(f"{path.name}: not one picture of this video can be decoded")
        self.times_ns = [number * interval_ns for number in range(count)]
        self._capture: cv2.VideoCapture | None = None
        self._at = 0
        self._last: tuple[int, NDArray[np.uint8] | None] = (-1, None)

    def picture(self, number: int) -> NDArray[np.uint8] | None:
        """Return a picture, (H, W) uint8; None where it cannot be decoded."""
        if number == self._last[0]:
            return self._last[1]
        if self._capture is None or number < self._at:
            self.close()
            self._capture, self._at = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG), 0
        image: NDArray[np.uint8] | None = None
        while self._at <= number:
            if not self._capture.grab():
                break
            self._at += 1
        if self._at == number + 1:
            decoded, colour = self._capture.retrieve()
            if decoded and colour is not None and colour.size:
                grey = colour if colour.ndim == 2 else cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
                image = np.ascontiguousarray(grey, dtype=np.uint8)
        self._last = (number, image)
        return image

    def pose(self, number: int) -> Pose | None:  # noqa: ARG002  a video has none
        """Return None: a video tells no poses."""
        return None

    def close(self) -> None:
        """Release the decoder."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def _load_poses(path: Path) -> RecordedPoses | None:
    if not path.is_file():
        return None
    try:
        return RecordedPoses.load(path)
    except (OSError, ValueError) as error:
        raise SourceError(str(error)) from error
