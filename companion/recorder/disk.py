"""The folder of recordings: names, how much there is, and making room for more."""

from __future__ import annotations

import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_NAME: Final = re.compile(r"void-\d{8}T\d{6}Z(-\d+)?\.(mcap|tlog)")
MIB: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """What recordings may take, in bytes: one file, all of them, and what the disk keeps free for others."""

    file_bytes: int
    total_bytes: int
    keep_free_bytes: int


@dataclass(frozen=True, slots=True)
class Recording:
    """A file of the folder."""

    path: Path
    size_bytes: int
    changed_ns: int


def recordings(folder: Path) -> list[Recording]:
    """Return the recordings of a folder, the oldest first; files of other names are nobody's business here."""
    found: list[Recording] = []
    try:
        entries = list(os.scandir(folder))
    except FileNotFoundError:
        return []
    for entry in entries:
        if not _NAME.fullmatch(entry.name) or not entry.is_file(follow_symlinks=False):
            continue
        try:
            about = entry.stat(follow_symlinks=False)
        except FileNotFoundError:  # somebody tidies up
            continue
        found.append(Recording(Path(entry.path), about.st_size, about.st_mtime_ns))
    return sorted(found, key=lambda recording: (recording.changed_ns, recording.path.name))


def make_room(folder: Path, limits: Limits, *, keep: frozenset[Path], wanted_bytes: int = 0) -> str | None:
    """Delete the oldest recordings until all is within the limits.

    Parameters
    ----------
    folder
        Of the recordings.
    limits
        To be held.
    keep
        Files that are being written.
    wanted_bytes
        What is about to be written.

    Returns
    -------
    Why there is no room; None: there is.

    Raises
    ------
    OSError
        When the folder cannot be looked at.
    """
    there = recordings(folder)
    total = sum(recording.size_bytes for recording in there) + wanted_bytes
    old = [recording for recording in there if recording.path not in keep]
    free = free_bytes(folder) - wanted_bytes
    for recording in old:
        if total <= limits.total_bytes and free >= limits.keep_free_bytes:
            break
        try:
            recording.path.unlink()
        except OSError:  # read-only, or gone
            continue
        total -= recording.size_bytes
        free = free_bytes(folder) - wanted_bytes
    if free < limits.keep_free_bytes:
        return f"disk full: {max(0, free) // MIB} MiB free, {limits.keep_free_bytes // MIB} MiB are kept"
    if total > limits.total_bytes:
        return f"the recordings are at {limits.total_bytes // MIB} MiB, which is recorder.total_mib"
    return None


def free_bytes(folder: Path) -> int:
    """Return the free space of the folder's disk."""
    about = os.statvfs(folder)
    return about.f_bavail * about.f_frsize


def new_name(folder: Path, wall_ns: int) -> Path:
    """Return a name (without its ending) that no recording has, by the time of day."""
    stem = time.strftime("void-%Y%m%dT%H%M%SZ", time.gmtime(wall_ns // 1_000_000_000))
    name, number = stem, 1
    while any((folder / f"{name}{ending}").exists() for ending in (".mcap", ".tlog")):
        number += 1
        name = f"{stem}-{number}"
    return folder / name


class GrowingFile:
    """A file that is written to its end, without a buffer in between: what has been written survives our death.

    Parameters
    ----------
    path
        Must not exist.

    Raises
    ------
    OSError
        When it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        self._size = 0

    def write(self, data: bytes) -> int:
        """Write all of it; raises OSError where that cannot be done."""
        view = memoryview(data)
        while view:
            written = os.write(self._fd, view)
            self._size += written
            view = view[written:]
        return len(data)

    def tell(self) -> int:
        """Return how much has been written."""
        return self._size

    def flush(self) -> None:
        """Nothing waits here."""

    def sync(self) -> None:
        """Have the kernel write it to the disk; raises OSError where that fails."""
        os.fdatasync(self._fd)

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)
