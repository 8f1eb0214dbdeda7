"""Where the configuration comes from: files, environment and command line, in one order, and what each of them has set.

The order, later wins:

1. the defaults (``companion.config``)
2. the main file, ``config.toml``
3. the files ``*.toml`` of the folder beside it that has its name, ``config.d/``, by name
4. what the live page has saved, where it does not save to the main file itself (``web.saved_file``)
5. what a ground station has set (``ground_station.parameters_file``)
6. the environment, ``VOID_COMPANION_GUIDANCE__MAX_STEP_M=1.0``
7. the command line, ``-o guidance.max_step_m=1.0``

Settings of page and ground station come after the files, or they would be lost with a restart; before the environment and the
command line, which are meant for this run. A ground station is not told what is read later than its own and wins, the page is.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from companion.config import Config
from companion.config_file import config_of, merged, parse_table, read_text, section_schemas, toml_value
from companion.errors import ConfigError

ENVIRONMENT_PREFIX: Final = "VOID_COMPANION_"
DEFAULT_NAME: Final = "default"
FOLLOWS_NAME: Final = "follows from what is set"
_PATH_KEYS: Final = (
    "camera.file",
    "detector.params_file",
    "link.signing_key_file",
    "status.socket",
    "web.recordings",
    "web.saved_file",
    "web.settings_file",
    "web.token_file",
)
_FILE_SCHEME: Final = "file:"
_MARKS_OF_TOML: Final = ("[", '"', "'")


@dataclass(frozen=True, slots=True)
class ConfigPlaces:
    """Where a configuration is looked for.

    Attributes
    ----------
    file
        The main file; None: there is none, and nothing beside it.
    environment
        Variables; those that begin with `ENVIRONMENT_PREFIX` count.
    options
        ``TABLE.KEY=VALUE``, as the command line has them.
    """

    file: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    options: tuple[str, ...] = ()

    @property
    def drop_in_folder(self) -> Path | None:
        """The folder with further files: ``config.d`` for ``config.toml``."""
        return None if self.file is None else self.file.with_suffix(".d")

    def drop_ins(self) -> tuple[Path, ...]:
        """Return the further files by name, without hidden ones, which are an editor's.

        Raises
        ------
        companion.errors.ConfigError
            When the folder cannot be read.
        """
        folder = self.drop_in_folder
        if folder is None:
            return ()
        try:
            names = [path.name for path in folder.iterdir()]
        except (FileNotFoundError, NotADirectoryError):
            return ()
        except (OSError, ValueError) as error:  # ValueError: a null character in the name
            raise ConfigError(f"{folder}: cannot be read: {error}") from error
        return tuple(folder / name for name in sorted(names) if name.endswith(".toml") and name[0] != ".")


@dataclass(frozen=True, slots=True)
class Layer:
    """What one place has set.

    Attributes
    ----------
    name
        For people: a file, ``environment NAME`` or ``-o KEY``.
    folder
        Relative paths in it are relative to this.
    table
        Its keys by table, as parsed and not yet judged.
    """

    name: str
    folder: Path
    table: Mapping[str, Any]

    def sets(self, key: str) -> bool:
        """Return whether a dotted key, or a whole table, is set here."""
        section, _, name = key.partition(".")
        if section not in self.table:
            return False
        table = self.table[section]
        return not name or not isinstance(table, Mapping) or name in table


@dataclass(frozen=True, slots=True)
class LoadedConfig:
    """A configuration and where it comes from.

    Attributes
    ----------
    config
        With all paths absolute.
    layers
        What was read, in the order in which it counts.
    """

    config: Config
    layers: tuple[Layer, ...]

    def origin(self, key: str) -> str:
        """Return where the value of a dotted key comes from.

        Where nobody has set it: `DEFAULT_NAME`, or `FOLLOWS_NAME` of one that depends on what else is set, such as where
        a ground station's settings are kept.
        """
        layer = _setter(self.layers, key)
        if layer is not None:
            return layer.name
        section, _, name = key.partition(".")
        is_default = getattr(getattr(self.config, section), name) == getattr(getattr(Config(), section), name)
        return DEFAULT_NAME if is_default else FOLLOWS_NAME


def load_config(path: str | Path) -> Config:
    """Read a configuration file, the files of its drop-in folder and what a ground station has set.

    Raises
    ------
    companion.errors.ConfigError
        With every fault of the files, one a line.
    """
    return load(ConfigPlaces(Path(path))).config


def load(places: ConfigPlaces, *, unsaved: Mapping[str, Any] | None = None) -> LoadedConfig:
    """Read a configuration from all its places.

    Parameters
    ----------
    places
        Where to look.
    unsaved
        Values by dotted key that a ground station has set and that are not in their file yet: they count as if they were.

    Raises
    ------
    companion.errors.ConfigError
        With every fault, one a line; each names the place that has set the value.
    """
    files = _file_layers(places)
    last = [*_environment_layers(places.environment), *_option_layers(places.options)]
    saved = _saved_file(places, (*files, *last))
    page = _overlay_layers(places, saved)
    tuned = _tuned_file(places, (*files, *page, *last))
    station = _overlay_layers(places, tuned)
    for key, value in (unsaved or {}).items():
        station.append(Layer("ground station, not written yet", _folder_of(places), _table_of(key, value)))
    layers = (*files, *page, *station, *last)
    table: dict[str, Any] = {}
    for layer in layers:
        table = merged(table, layer.table)

    def place_of(key: str) -> str:
        setter = _setter(layers, key)
        if setter is not None:
            return setter.name
        return layers[0].name if layers else "configuration"

    config = config_of(table, name=place_of)
    return LoadedConfig(_with_page_files(_resolved(config, layers, tuned), places, saved), layers)


def shown_with_origins(loaded: LoadedConfig) -> str:
    """Return a configuration as TOML, each value with where it comes from."""
    parts = [
        "# Each value with where it comes from; later wins: file, drop-ins by name, live page, ground station, environment, -o.\n"
    ]
    for section, schema in section_schemas().items():
        table = getattr(loaded.config, section)
        lines = [
            (f"{key} = {toml_value(_plain(getattr(table, key)))}", loaded.origin(f"{section}.{key}"))
            for key in schema["properties"]
        ]
        width = min(48, max(len(text) for text, _ in lines))
        parts.append(f"\n[{section}]\n")
        parts.extend(f"{text:<{width}}  # {origin}\n" for text, origin in lines)
    return "".join(parts)


def _plain(value: Any) -> bool | float | str | list[str]:
    if isinstance(value, list | tuple):
        return [str(item) for item in value]
    plain: bool | float | str = value
    return plain


def _setter(layers: Sequence[Layer], key: str) -> Layer | None:
    """Return the last layer that sets a dotted key."""
    return next((layer for layer in reversed(layers) if layer.sets(key)), None)


def _folder_of(places: ConfigPlaces) -> Path:
    return Path.cwd() if places.file is None else places.file.absolute().parent


def _file_layers(places: ConfigPlaces) -> list[Layer]:
    if places.file is None:
        return []
    folder = _folder_of(places)
    return [
        Layer(str(path), folder, parse_table(read_text(path), name=str(path)))
        for path in (places.file, *places.drop_ins())
    ]


def _environment_layers(environment: Mapping[str, str]) -> list[Layer]:
    layers = []
    for name in sorted(name for name in environment if name.startswith(ENVIRONMENT_PREFIX)):
        section, separator, key = name.removeprefix(ENVIRONMENT_PREFIX).lower().partition("__")
        if not (section and separator and key):
            raise ConfigError(f"environment {name}: allowed: {ENVIRONMENT_PREFIX}TABLE__KEY")
        dotted = f"{section}.{key}"
        value = value_from_text(dotted, environment[name])
        layers.append(Layer(f"environment {name}", Path.cwd(), _table_of(dotted, value)))
    return layers


def _option_layers(options: Sequence[str]) -> list[Layer]:
    layers = []
    for option in options:
        dotted, is_set, text = option.partition("=")
        dotted = dotted.strip()
        section, _, key = dotted.partition(".")
        if not (is_set and section and key):
            raise ConfigError(f"-o {option}: allowed: TABLE.KEY=VALUE")
        layers.append(
            Layer(f"-o {dotted}", Path.cwd(), _table_of(dotted, value_from_text(dotted, text.strip())))
        )
    return layers


def value_from_text(key: str, text: str) -> Any:
    """Return what a text means as the value of a dotted key.

    Numbers, booleans and lists are written as in TOML. Text may stand without quotation marks. What fits neither stays
    text, which the key then refuses.
    """
    section, _, name = key.partition(".")
    facts = section_schemas().get(section, {}).get("properties", {}).get(name, {})
    is_text = facts.get("type") not in ("number", "integer", "boolean")
    if is_text and not text.startswith(_MARKS_OF_TOML):
        return text
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return parsed["value"] if parsed.keys() == {"value"} else text


def _table_of(dotted: str, value: Any) -> dict[str, Any]:
    section, _, key = dotted.partition(".")
    return {section: {key: value}}


def _overlay_layers(places: ConfigPlaces, path: Path | None) -> list[Layer]:
    """Return what a file holds that the service itself writes; nothing where there is none yet."""
    if path is None or not path.exists():
        return []
    return [Layer(str(path), _folder_of(places), parse_table(read_text(path), name=str(path)))]


def _state_folder() -> Path | None:
    """Return where a unit of systemd may write, which is not beside its configuration (systemd.exec, StateDirectory=)."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(state) if state else None


def _named(layers: Sequence[Layer], section: str, key: str) -> Path | None:
    """Return the file that a key names, relative to who names it; what is not text is refused with the rest."""
    setter = _setter(layers, f"{section}.{key}")
    if setter is None or not isinstance(setter.table[section], Mapping):
        return None
    named = setter.table[section][key]
    return setter.folder / named if isinstance(named, str) and named else None


def _saved_file(places: ConfigPlaces, layers: Sequence[Layer]) -> Path | None:
    """Return where the live page saves to in place of the main file; None: to that file."""
    named, state = _named(layers, "web", "saved_file"), _state_folder()
    if named is not None or places.file is None or state is None:
        return named
    return state / f"{places.file.stem}.page.toml"


def _with_page_files(config: Config, places: ConfigPlaces, saved: Path | None) -> Config:
    """Return a configuration that says which files the live page compares with and saves to."""
    if places.file is None:
        return config
    updates: dict[str, str] = {}
    if saved is not None and not config.web.settings_file:  # one that is named is saved to itself
        updates["saved_file"] = str(saved)
    if config.web.enabled and not config.web.settings_file:
        updates["settings_file"] = str(places.file.absolute())
    return config.model_copy(update={"web": config.web.model_copy(update=updates)}) if updates else config


def _tuned_file(places: ConfigPlaces, layers: Sequence[Layer]) -> Path | None:
    """Return where a ground station's settings are kept: where it is named, else where the service may write."""
    named = _named(layers, "ground_station", "parameters_file")
    if named is not None or places.file is None:
        return named
    return (_state_folder() or _folder_of(places)) / f"{places.file.stem}.tuned.toml"


def _resolved(config: Config, layers: Sequence[Layer], tuned: Path | None) -> Config:
    """Return a configuration with its relative paths made absolute, each by the place that has set it."""
    paths: dict[str, str] = {}
    for key in _PATH_KEYS:
        section, _, name = key.partition(".")
        paths[key] = getattr(getattr(config, section), name)
    if config.source.scheme == "file":
        paths["source.url"] = config.source.where
    updates: dict[str, dict[str, str]] = {}
    if tuned is not None:
        updates["ground_station"] = {"parameters_file": str(tuned)}
    for key, value in paths.items():
        setter = _setter(layers, key)
        if not value or setter is None:
            continue
        section, _, name = key.partition(".")
        scheme = _FILE_SCHEME if key == "source.url" else ""
        updates.setdefault(section, {})[name] = f"{scheme}{setter.folder / value}"
    return config.model_copy(
        update={
            section: getattr(config, section).model_copy(update=keys) for section, keys in updates.items()
        }
    )
