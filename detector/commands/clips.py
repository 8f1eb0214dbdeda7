"""Clips as commands read and write them: a video file, or a folder of images that may have poses."""

from __future__ import annotations

import contextlib
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from detector.commands import inputs
from detector.commands.inputs import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from detector.camera_model import CameraModel
    from detector.observer import CameraPose

_IMAGE_SUFFIXES: Final = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".pnm", ".tif", ".tiff", ".webp"}
)
_MAX_RATE_HZ: Final = 1000.0
_CODECS: Final = {
    ".avi": "MJPG",
    ".mkv": "mp4v",
    ".mov": "mp4v",
    ".mp4": "mp4v",
    ".webm": "VP80",
}
"""Codec by the ending of the file's name: those that OpenCV's own packages have."""


@dataclass(frozen=True, slots=True)
class ClipFrame:
    """One frame of a clip.

    Attributes
    ----------
    time_s
        Since the first frame.
    image
        (H, W) uint8.
    name
        Of its file; None in a video.
    """

    time_s: float
    image: NDArray[np.uint8]
    name: str | None


class FolderClip:
    """The images of a folder, in natural order of their names.

    A folder without images of its own but with a folder ``images`` stands for that one.

    Parameters
    ----------
    folder
        Where.
    rate_hz
        Frames in a second.

    Raises
    ------
    InputError
        There is no image, or the folder cannot be read.
    """

    def __init__(self, folder: Path, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.folder = folder
        self._files = _images_of(folder)
        if not self._files and (folder / "images").is_dir():
            self.folder = folder / "images"
            self._files = _images_of(self.folder)
        if not self._files:
            raise InputError(f"{folder}: no images in this folder ({', '.join(sorted(_IMAGE_SUFFIXES))})")

    @property
    def total(self) -> int:
        """Number of frames."""
        return len(self._files)

    def frames(self) -> Iterator[ClipFrame]:
        """Read the frames one by one.

        Raises
        ------
        InputError
            One cannot be read.
        """
        for number, file in enumerate(self._files):
            yield ClipFrame(number / self.rate_hz, inputs.read_image(file), file.name)


class VideoClip:
    """A video file, as OpenCV reads it.

    Parameters
    ----------
    path
        Which.
    rate_hz
        Frames in a second where the file does not say.

    Raises
    ------
    InputError
        It is no video that can be read.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        import cv2

        # Read once, at the first use of FFmpeg: damaged frames are left out, without a message for each.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        try:
            with path.open("rb"):  # says why not, which OpenCV does not
                pass
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read: {inputs.cause(error)}") from error
        with _quiet():
            self._capture = cv2.VideoCapture(str(path))
            if not self._capture.isOpened():
                raise InputError(f"{path}: is not a video that can be decoded")
        self._path = path
        stated_hz = self._capture.get(cv2.CAP_PROP_FPS)
        stated_frames = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self._total = int(stated_frames) if 0.0 < stated_frames < 1e9 else None
        self.rate_hz = stated_hz if math.isfinite(stated_hz) and 0.0 < stated_hz <= _MAX_RATE_HZ else rate_hz

    @property
    def total(self) -> int | None:
        """Number of frames as the file states it; None where it does not."""
        return self._total

    def frames(self) -> Iterator[ClipFrame]:
        """Decode the frames one by one, with the container's times where they increase, else by the frame rate.

        Raises
        ------
        InputError
            There is no frame at all.
        """
        import cv2
        import numpy as np

        first_s = last_s = None
        try:
            while True:
                done, colour = self._capture.read()
                if not done:
                    break
                stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                first_s = stamp_s if first_s is None else first_s
                time_s = stamp_s - first_s
                if last_s is not None and not (math.isfinite(time_s) and time_s > last_s):
                    time_s = last_s + 1.0 / self.rate_hz
                last_s = time_s
                grey = colour if colour.ndim == 2 else cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
                yield ClipFrame(time_s, np.asarray(grey, np.uint8), None)
        finally:
            self._capture.release()
        if last_s is None:
            raise InputError(f"{self._path}: holds no frame that can be decoded")


def open_clip(source: Path, rate_hz: float) -> FolderClip | VideoClip:
    """Open a folder of images or a video file.

    Raises
    ------
    InputError
        It cannot be played.
    """
    try:
        is_folder = source.is_dir()
    except (OSError, ValueError) as error:
        raise InputError(f"{source}: cannot be read: {inputs.cause(error)}") from error
    return FolderClip(source, rate_hz) if is_folder else VideoClip(source, rate_hz)


def _images_of(folder: Path) -> list[Path]:
    from detector.video import natural_key

    try:
        files = [
            file for file in folder.iterdir() if file.suffix.lower() in _IMAGE_SUFFIXES and file.is_file()
        ]
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {inputs.cause(error)}") from error
    return sorted(files, key=lambda file: natural_key(file.name))


def poses_of(clip: FolderClip) -> tuple[CameraModel | None, dict[str, CameraPose]]:
    """Return the camera and the poses by file name that a folder's ``groundtruth.json`` or ``poses.json`` holds, if it has one.

    Raises
    ------
    InputError
        There is such a file and it cannot be used.
    """
    try:
        return poses_beside(clip.folder)
    except InputError as error:
        raise InputError(f"{error} (--no-poses leaves it aside)") from error


def known_beside(folder: Path, *names: str) -> Path | None:
    """Return the first of these files that lies beside the images of a folder, or beside the folder when that is called ``images``."""
    folders = [folder] + ([folder.parent] if folder.name == "images" else [])
    files = [each / name for each in folders for name in names]
    return next((file for file in files if file.is_file()), None)


def poses_beside(folder: Path) -> tuple[CameraModel | None, dict[str, CameraPose]]:
    """Return the camera and the poses, by file name, of images in a folder (:func:`known_beside`); neither where no file says them.

    The poses' world is turned so that its z axis points down, where it can be told which way that is.

    Raises
    ------
    InputError
        There is such a file and it cannot be used.
    """
    import numpy as np

    from detector.evaluation.dataset import POSES_FILE, TRUTH_FILE, DatasetError, load_truth
    from detector.observer import CameraPose

    found = known_beside(folder, TRUTH_FILE, POSES_FILE)
    if found is None:
        return None, {}
    try:
        known = load_truth(found)
    except DatasetError as error:
        raise InputError(inputs.one_line(error)) from error
    poses: dict[str, CameraPose] = {}
    level_from_world = known.level_from_world()
    level = np.eye(3) if level_from_world is None else level_from_world
    for name, frame in known.frames.items():
        if frame.pose is not None:
            pose = np.array(frame.pose, np.float64)
            poses[Path(name).name] = CameraPose(level @ pose[:3, :3], level @ pose[:3, 3])
    return known.camera, poses


class ClipWriter:
    """Writes pictures as a video; a context, whose end makes the file playable also after an error.

    Parameters
    ----------
    path
        Its ending names the container.
    rate_hz
        Frames in a second.
    codec
        Four characters; by the ending where not given.

    Raises
    ------
    InputError
        The ending is that of no container known here.
    """

    def __init__(self, path: Path, rate_hz: float, codec: str | None = None) -> None:
        self.path = path
        if path.suffix.lower() not in _CODECS:
            raise InputError(
                f"-o {path}: found the ending {path.suffix!r}, allowed are {', '.join(sorted(_CODECS))}"
            )
        self.codec = codec or _CODECS[path.suffix.lower()]
        self.written = 0
        self._rate_hz = rate_hz
        self._size_px = (0, 0)
        self._writer: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.release()
            self._writer = None

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Append a picture (H, W, 3); the first one decides the size, others are fitted into it.

        Raises
        ------
        InputError
            The file cannot be written, or not with this codec.
        """
        from detector.video import fitted

        if self._writer is None:
            self._size_px = (picture.shape[1], picture.shape[0])
            self._open()
        self._writer.write(fitted(picture, self._size_px))
        self.written += 1

    def check(self) -> None:
        """Make sure, after the end, that the file can be played.

        Raises
        ------
        InputError
            It cannot: the disk is full, for example.
        """
        import cv2

        with _quiet():
            capture = cv2.VideoCapture(str(self.path))
            done = capture.isOpened() and capture.read()[0]
            capture.release()
        if not done:
            raise InputError(f"-o {self.path}: what was written cannot be played; is the disk full?")

    def _open(self) -> None:
        import cv2

        existed = self.path.exists()
        try:
            with self.path.open("ab"):  # says why not, which OpenCV does not
                pass
        except (OSError, ValueError) as error:
            raise InputError(f"-o {self.path}: cannot be written: {inputs.cause(error)}") from error
        fourcc = cv2.VideoWriter.fourcc(*self.codec)
        with _quiet():
            writer = cv2.VideoWriter(str(self.path), fourcc, self._rate_hz, self._size_px)
        if not writer.isOpened():
            if not existed:
                self.path.unlink(missing_ok=True)
            raise InputError(
                f"-o {self.path}: the codec {self.codec} cannot be opened; --codec names another one, "
                f"{_CODECS[self.path.suffix.lower()]} is the usual one for {self.path.suffix}"
            )
        self._writer = writer


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what OpenCV and FFmpeg print while a file is opened off stderr: our message is one line.

    Some of it goes past every setting, straight to the descriptor.
    """
    sys.stderr.flush()
    before = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
