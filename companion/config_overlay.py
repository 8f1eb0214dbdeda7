"""Keeps what was set in flight: a small TOML file that is read after the configuration and wins.

It holds only what was changed, one key a line, and is replaced as a whole: whoever reads it, after a power cut too,
finds the old file or the new one.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from companion.config_file import merged, parse_table, read_text, toml_value
from companion.errors import ConfigError

Value = bool | int | float | str

_HEAD: Final = "# Set from a ground station; read after the configuration, and wins. Delete a line, or this file, to undo.\n"


def overlay_text(table: Mapping[str, Mapping[str, Value]]) -> str:
    """Return a table of tables as TOML, in its order."""
    parts = [_HEAD]
    for section, keys in table.items():
        lines = "".join(f"{key} = {toml_value(value)}\n" for key, value in keys.items())
        parts.append(f"\n[{section}]\n{lines}")
    return "".join(parts)


def write_overlay(path: Path, changes: Mapping[str, Value]) -> None:
    """Put changes into an overlay file; what else it holds stays.

    Parameters
    ----------
    path
        The file; made where there is none.
    changes
        Values by dotted key, ``guidance.max_step_m``.

    Raises
    ------
    companion.errors.ConfigError
        When the file that is there cannot be read, or the new one cannot be written; the old one is then as it was.
    """
    table: dict[str, dict[str, Value]] = (
        {section: dict(keys) for section, keys in parse_table(read_text(path), name=str(path)).items()}
        if path.exists()
        else {}
    )
    for dotted, value in changes.items():
        section, _, key = dotted.partition(".")
        table = merged(table, {section: {key: value}})
    try:
        replace_file(path, overlay_text(table).encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def replace_file(path: Path, data: bytes) -> None:
    """Write a file beside the old one, to the disk, and then put it in its place.

    Raises
    ------
    OSError
        When it cannot be written; the old one is then as it was.
    """
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    new = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            new.chmod(path.stat().st_mode & 0o777)
        else:
            new.chmod(0o644)
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
