"""Recordings on the page: listed, opened, and looked at with other settings, all in a worker process (``studio_child``)."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import socket
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from companion.config import Config
from companion.config_file import config_of, merged
from companion.errors import CompanionError, ConfigError, SourceError
from companion.web.clips import kind_of
from companion.web.studio_child import HEADER

_PICTURE_WIDTH_PX: Final = 960
_PICTURE_QUALITY: Final = 75
_KEPT_PICTURES: Final = 60
_MOST_LISTED: Final = 500
MOST_COMPARED: Final = 600
"""Pictures of one comparison."""
_KEPT_COMPARISONS: Final = 2
_BUDGET_S: Final = 0.25
"""Between these, pictures are decoded for who scrubs meanwhile."""
_PATIENCE_S: Final = 60.0
_COMPARED_TABLES: Final = ("detector.", "camera.")
_ROWS_AT_ONCE: Final = 60


@dataclass
class _Comparison:
    """What is known of one comparison so far."""

    rows: list[str] = field(default_factory=list)
    """JSON of each."""
    is_done: bool = False
    error: str = ""
    task: asyncio.Task[None] | None = None


class Studio:
    """Recordings of one folder, or one recording.

    Parameters
    ----------
    root
        A folder of recordings, or a recording; None: there are none.
    config
        Returns the configuration that comparisons begin from, by table.
    why_not
        Returns why nothing may be compared now; "": it may.
    """

    def __init__(
        self, root: Path | None, config: Callable[[], Mapping[str, Any]], why_not: Callable[[], str]
    ) -> None:
        self._root = None if root is None else root.absolute()
        self._config = config
        self._why_not = why_not
        self._worker = _Worker()
        self._pictures: OrderedDict[tuple[str, int], bytes] = OrderedDict()
        self._comparisons: OrderedDict[int, _Comparison] = OrderedDict()
        self._numbers = 0

    async def recordings(self) -> list[dict[str, Any]]:
        """Return the recordings that there are, the newest first."""
        found = await asyncio.to_thread(list_recordings, self._root)
        return [
            {
                "id": one.id,
                "name": one.name,
                "kind": one.kind,
                "bytes": one.size_bytes,
                "modified": one.modified_s,
            }
            for one in found
        ]

    async def about(self, recording: str) -> dict[str, Any]:
        """Return how many pictures a recording has, when each was taken, and what else is in it.

        Raises
        ------
        companion.errors.SourceError
            When there is no such recording, or it cannot be opened.
        """
        found = await self._find(recording)
        answer, _ = await self._worker.ask({"do": "about", "path": str(found.path)})
        return {"id": found.id, "name": found.name, "kind": found.kind, **answer}

    async def picture(self, recording: str, number: int) -> bytes:
        """Return a picture as JPEG.

        Raises
        ------
        companion.errors.SourceError
            When there is none.
        """
        found = await self._find(recording)
        key = (f"{found.id} {found.modified_s}", number)
        if key in self._pictures:
            self._pictures.move_to_end(key)
            return self._pictures[key]
        request = {
            "do": "picture",
            "path": str(found.path),
            "number": number,
            "width_px": _PICTURE_WIDTH_PX,
            "quality": _PICTURE_QUALITY,
        }
        _, jpeg = await self._worker.ask(request)
        self._pictures[key] = jpeg
        if len(self._pictures) > _KEPT_PICTURES:
            self._pictures.popitem(last=False)
        return jpeg

    async def compare(
        self, recording: str, first: int, last: int, settings: Sequence[Mapping[str, Any]]
    ) -> dict[str, Any]:
        """Begin to look at pictures with each of the settings; one that still runs is ended.

        Parameters
        ----------
        recording
            Its id.
        first, last
            Pictures, at most `MOST_COMPARED`.
        settings
            Of each lane, values by dotted key that differ from the configuration; ``detector.`` and ``camera.`` alone.

        Returns
        -------
        ``number``, to ask for it by.

        Raises
        ------
        companion.errors.CompanionError
            When that may not be now, or cannot be.
        """
        if why_not := self._why_not():
            raise SourceError(why_not)
        if last - first >= MOST_COMPARED:
            raise SourceError(
                f"found {last - first + 1} pictures; allowed: {MOST_COMPARED} in one comparison"
            )
        configs = [self._config_with(values).model_dump_json() for values in settings]
        found = await self._find(recording)
        for number in list(self._comparisons):
            await self._end_task(number)
        request = {
            "do": "compare",
            "path": str(found.path),
            "first": first,
            "last": last,
            "configs": configs,
        }
        await self._worker.ask(request)
        self._numbers += 1
        comparison = self._comparisons[self._numbers] = _Comparison()
        while len(self._comparisons) > _KEPT_COMPARISONS:
            self._comparisons.popitem(last=False)
        comparison.task = asyncio.create_task(self._run(comparison), name=f"comparison-{self._numbers}")
        return {"number": self._numbers}

    def comparison(self, number: int, after: int) -> dict[str, Any]:
        """Return rows of a comparison that come after the first so many, some at a time.

        Raises
        ------
        companion.errors.SourceError
            When there is no such comparison any more.
        """
        comparison = self._comparisons.get(number)
        if comparison is None:
            raise SourceError("there is no such comparison any more")
        rows = comparison.rows[after : after + _ROWS_AT_ONCE]
        return {
            "rows": [json.loads(row) for row in rows],
            "done": comparison.is_done and after + len(rows) >= len(comparison.rows),
            "error": comparison.error,
        }

    async def end_comparison(self, number: int) -> None:
        """End a comparison and forget it."""
        await self._end_task(number)
        self._comparisons.pop(number, None)

    async def close(self) -> None:
        """End the worker process."""
        for number in list(self._comparisons):
            await self._end_task(number)
        await self._worker.close()

    async def _run(self, comparison: _Comparison) -> None:
        try:
            while not comparison.is_done:
                if why_not := self._why_not():
                    raise SourceError(why_not)
                answer, _ = await self._worker.ask({"do": "advance", "budget_s": _BUDGET_S})
                comparison.rows += [json.dumps(row, separators=(",", ":")) for row in answer["rows"]]
                comparison.is_done = answer["done"]
        except CompanionError as error:
            comparison.error, comparison.is_done = str(error), True

    async def _end_task(self, number: int) -> None:
        comparison = self._comparisons.get(number)
        if comparison is not None and comparison.task is not None:
            comparison.task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await comparison.task
            comparison.task, comparison.is_done = None, True

    def _config_with(self, values: Mapping[str, Any]) -> Config:
        table: dict[str, Any] = dict(self._config())
        for key, value in values.items():
            if not key.startswith(_COMPARED_TABLES):
                raise ConfigError(f"{key}: only settings of the detector and the camera can be compared")
            section, _, name = key.partition(".")
            table = merged(table, {section: {name: value}})
        return config_of(table, name="settings")

    async def _find(self, recording: str) -> Recorded:
        # Looked up among those that there are: what a client says never becomes part of a path.
        for found in await asyncio.to_thread(list_recordings, self._root):
            if found.id == recording:
                return found
        raise SourceError("there is no such recording")


@dataclass(frozen=True, slots=True)
class Recorded:
    """One recording that can be opened.

    Attributes
    ----------
    id
        Stands for it in addresses.
    path, name, kind
        Where it is, how it is shown, and what it is (``companion.web.clips.kind_of``).
    size_bytes, modified_s
        Of the file; a folder has no size.
    """

    id: str
    path: Path
    name: str
    kind: str
    size_bytes: int
    modified_s: float


def list_recordings(root: Path | None) -> list[Recorded]:
    """Return what can be opened in a folder, two folders deep, the newest first; links that lead out of it are not followed."""
    if root is None:
        return []
    if kind_of(root) is not None:
        return [_recorded(root, root.name)]
    found: list[Recorded] = []
    inside = root.resolve()
    for path in _entries(root):
        # A folder of images is one recording; any other folder may hold some.
        candidates = [path] if kind_of(path) is not None or not path.is_dir() else _entries(path)
        found.extend(
            _recorded(candidate, str(candidate.relative_to(root)))
            for candidate in candidates
            if kind_of(candidate) is not None and candidate.resolve().is_relative_to(inside)
        )
    found.sort(key=lambda one: (-one.modified_s, one.name))
    return found[:_MOST_LISTED]


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


def _recorded(path: Path, name: str) -> Recorded:
    kind = kind_of(path) or ""
    try:
        about = path.stat()
    except OSError:
        return Recorded(_id_of(name), path, name, kind, 0, 0.0)
    return Recorded(
        _id_of(name), path, name, kind, about.st_size if path.is_file() else 0, round(about.st_mtime, 3)
    )


def _id_of(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:12]


class _Worker:
    """The worker process, started when it is first needed; one request at a time."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def ask(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Return the answer to a request and the bytes behind it.

        Raises
        ------
        companion.errors.SourceError
            When it cannot be done; says why.
        """
        async with self._turn:
            try:
                async with asyncio.timeout(_PATIENCE_S):
                    answer, data = await self._exchange(request)
            except TimeoutError as error:
                await self._end()
                raise SourceError("took too long; given up") from error
            except (OSError, EOFError) as error:
                await self._end()
                raise SourceError("the process that looks at recordings has ended; try again") from error
            except asyncio.CancelledError:
                await self._end()  # else its answer would be taken for the next one's
                raise
        if "error" in answer:
            raise SourceError(str(answer["error"]))
        return answer, data

    async def close(self) -> None:
        """End the process."""
        async with self._turn:
            await self._end()

    async def _exchange(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        if self._process is None or self._process.poll() is not None:
            await self._end()
            await self._start()
        if self._reader is None or self._writer is None:
            raise EOFError
        text = json.dumps(request).encode()
        self._writer.write(HEADER.pack(len(text), 0) + text)
        await self._writer.drain()
        length, data_bytes = HEADER.unpack(await self._reader.readexactly(HEADER.size))
        answer: dict[str, Any] = json.loads(await self._reader.readexactly(length))
        return answer, await self._reader.readexactly(data_bytes)

    async def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = await asyncio.to_thread(_popen, theirs.fileno())
        self._reader, self._writer = await asyncio.open_connection(sock=ours)

    async def _end(self) -> None:
        process, writer = self._process, self._writer
        self._process = self._reader = self._writer = None
        if writer is not None:
            writer.close()
        if process is not None:
            process.kill()  # it writes nothing that could be half done
            await asyncio.to_thread(process.wait)


def _popen(fd: int) -> subprocess.Popen[bytes]:
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "companion.web.studio_child", str(fd)],
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr.fileno() if _has_descriptor(sys.stderr) else subprocess.DEVNULL,
        pass_fds=(fd,),
        env={**os.environ, **threads, "PYTHONPATH": path},
        start_new_session=True,  # a terminal's Ctrl-C is for who closes the socket
    )


def _has_descriptor(stream: Any) -> bool:
    try:
        stream.fileno()
    except (OSError, ValueError, AttributeError):
        return False
    return True
