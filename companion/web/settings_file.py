"""The configuration file that the page compares with, and the one that it saves to: comments and order stay as they are.

They are the same, unless the service may not write its configuration, as under systemd: then what was saved is in a file of its own
that is read after the configuration (``web.saved_file``).
"""

from __future__ import annotations

import difflib
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AbstractTable

from companion.config import Config
from companion.config_file import parse_config, read_text
from companion.config_overlay import replace_file
from companion.config_sources import ConfigPlaces, load
from companion.errors import ConfigError

_NO_FILE: Final = "the service was started without a configuration file"
_HEAD: Final = "# Saved by the live page; read after the configuration and its drop-in files, and wins. Delete a line, or this file, to undo.\n"


@dataclass(frozen=True, slots=True)
class OnDisk:
    """What the file, and what is read after it, would make of the next start.

    Attributes
    ----------
    config
        The configuration.
    origins
        Where each dotted key comes from; keys that nobody sets are not there.
    revision
        Changes with the content of the file, and of the one that is saved to.
    """

    config: Config
    origins: Mapping[str, str]
    revision: str


@dataclass(frozen=True, slots=True)
class SettingsFile:
    """One configuration file, and where what is saved goes to.

    Attributes
    ----------
    path
        Where it is; None: there is none.
    overlay
        Saved to in its place; made where there is none. None: the file itself is saved to.
    """

    path: Path | None
    overlay: Path | None = None

    @classmethod
    def of(cls, config: Config, path: Path | None) -> SettingsFile:
        """Return a file with the overlay that a configuration names."""
        return cls(path, Path(config.web.saved_file) if config.web.saved_file else None)

    @property
    def target(self) -> Path | None:
        """What is saved to; None: nothing can be."""
        return None if self.path is None else self.overlay or self.path

    def read(self) -> OnDisk:
        """Read it with its drop-ins, what a ground station has set, and the environment.

        Raises
        ------
        companion.errors.ConfigError
            When it cannot be used.
        """
        loaded = load(self._places())
        keys = [f"{section}.{key}" for layer in loaded.layers for section, key in _keys_of(layer.table)]
        revision = "" if self.path is None else revision_of(read_text(self.path) + self._overlay_text())
        return OnDisk(loaded.config, {key: loaded.origin(key) for key in keys}, revision)

    def save(self, values: Mapping[str, Any], *, revision: str, only_look: bool) -> str:
        """Put values into the file.

        Parameters
        ----------
        values
            By dotted key.
        revision
            Of the file that the values were compared with.
        only_look
            Do not write.

        Returns
        -------
        What changes, as a unified diff.

        Raises
        ------
        companion.errors.ConfigError
            When there is no file, it has changed meanwhile, the values cannot be used or it cannot be written.
        """
        target = self.target
        if self.path is None or target is None:
            raise ConfigError(_NO_FILE)
        main, overlay = read_text(self.path), self._overlay_text()
        if revision_of(main + overlay) != revision:
            raise ConfigError(f"{target.name} has changed meanwhile: compare again")
        old = main if self.overlay is None else overlay
        new = with_values(old, values, name=target.name, is_whole=self.overlay is None)
        if self.overlay is not None:
            load(self._places(), unsaved=values)  # with the files that it is read after it has to make sense
            new = new if old else f"{_HEAD}\n{new}"
        if not only_look and new != old:
            try:
                replace_file(target, new.encode())
            except OSError as error:
                raise ConfigError(f"{target}: cannot be written: {error.strerror}") from error
        lines = difflib.unified_diff(
            old.splitlines(keepends=True), new.splitlines(keepends=True), target.name, "saved", n=2
        )
        return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)

    def _places(self) -> ConfigPlaces:
        return ConfigPlaces(self.path, dict(os.environ))

    def _overlay_text(self) -> str:
        return read_text(self.overlay) if self.overlay is not None and self.overlay.exists() else ""


def revision_of(text: str) -> str:
    """Return what tells one content of the file from another."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:20]


def with_values(text: str, values: Mapping[str, Any], *, name: str, is_whole: bool = True) -> str:
    """Return a configuration file with values put in; comments, order and spaces stay (tomlkit).

    Parameters
    ----------
    text
        TOML.
    values
        By dotted key.
    name
        Stands in messages for the file.
    is_whole
        It is a configuration by itself and is judged as one.

    Raises
    ------
    companion.errors.ConfigError
        When the file that is there, or the one that would come of it, cannot be used.
    """
    try:
        document = tomlkit.parse(text)
        for dotted, value in values.items():
            section, _, key = dotted.partition(".")
            table = document.get(section)
            if table is None:
                table = tomlkit.table()
                document[section] = table
            if not isinstance(table, AbstractTable):
                raise ConfigError(f"{name}: [{section}] is no table")
            table[key] = value
        new = tomlkit.dumps(document)
    except TOMLKitError as error:
        raise ConfigError(f"{name}: {error}") from error
    if is_whole:
        parse_config(new, name=name)
    return new


def _keys_of(table: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(section, key) for section, keys in table.items() if isinstance(keys, Mapping) for key in keys]
