"""The configuration file that the page compares with and saves to: its comments and order stay as they are."""

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
        Changes with the file's content.
    """

    config: Config
    origins: Mapping[str, str]
    revision: str


@dataclass(frozen=True, slots=True)
class SettingsFile:
    """One configuration file.

    Attributes
    ----------
    path
        Where it is; None: there is none.
    """

    path: Path | None

    def read(self) -> OnDisk:
        """Read it with its drop-ins, what a ground station has set, and the environment.

        Raises
        ------
        companion.errors.ConfigError
            When it cannot be used.
        """
        loaded = load(ConfigPlaces(self.path, dict(os.environ)))
        keys = [f"{section}.{key}" for layer in loaded.layers for section, key in _keys_of(layer.table)]
        revision = "" if self.path is None else revision_of(read_text(self.path))
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
        if self.path is None:
            raise ConfigError(_NO_FILE)
        old = read_text(self.path)
        if revision_of(old) != revision:
            raise ConfigError(f"{self.path.name} has changed meanwhile: compare again")
        new = with_values(old, values, name=self.path.name)
        if not only_look and new != old:
            try:
                replace_file(self.path, new.encode())
            except OSError as error:
                raise ConfigError(f"{self.path}: cannot be written: {error.strerror}") from error
        lines = difflib.unified_diff(
            old.splitlines(keepends=True), new.splitlines(keepends=True), self.path.name, "saved", n=2
        )
        return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)


def revision_of(text: str) -> str:
    """Return what tells one content of the file from another."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:20]


def with_values(text: str, values: Mapping[str, Any], *, name: str) -> str:
    """Return a configuration file with values put in; comments, order and spaces stay (tomlkit).

    Parameters
    ----------
    text
        TOML.
    values
        By dotted key.
    name
        Stands in messages for the file.

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
    parse_config(new, name=name)
    return new


def _keys_of(table: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(section, key) for section, keys in table.items() if isinstance(keys, Mapping) for key in keys]
