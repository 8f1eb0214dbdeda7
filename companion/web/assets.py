"""The page's own files: read once at the start, served by name. A name that is not in the table is not there."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from importlib.resources import files
from typing import Final

_TYPES: Final = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "webmanifest": "application/manifest+json",
}


@dataclass(frozen=True, slots=True)
class Asset:
    """One file.

    Attributes
    ----------
    data, packed
        As it is, and by gzip.
    media_type
        For Content-Type.
    etag
        Changes with the data.
    """

    data: bytes
    packed: bytes
    media_type: str
    etag: str


def load_assets() -> dict[str, Asset]:
    """Return the page's files by name, ``index.html`` among them."""
    found: dict[str, Asset] = {}
    for entry in files("companion.web").joinpath("static").iterdir():
        media_type = _TYPES.get(entry.name.rpartition(".")[2])
        if media_type is None or not entry.is_file():
            continue
        data = entry.read_bytes()
        etag = f'"{hashlib.sha256(data).hexdigest()[:20]}"'
        found[entry.name] = Asset(data, gzip.compress(data, 9, mtime=0), media_type, etag)
    return found
