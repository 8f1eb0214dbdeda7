"""The configuration as a file: read strictly, and written with every key explained.

All faults of a file are reported at once, one a line, each with the file, the key, what was found and
what is allowed. The default file and those messages are made from the models in ``companion.config``.
Where values come from, and in which order, is in ``companion.config_sources``.
"""

from __future__ import annotations

import difflib
import json
import re
import textwrap
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from companion.config import Config, DisagreementError
from companion.errors import ConfigError

_MAX_FILE_BYTES = 1 << 20
_MAX_SHOWN = 60
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def parse_config(text: str, *, name: str = "configuration") -> Config:
    """Read a configuration from TOML text; ``name`` stands in messages for the file.

    Raises
    ------
    companion.errors.ConfigError
        With every fault of the text, one a line.
    """
    return config_of(parse_table(text, name=name), name=name)


def merged(table: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a configuration with another's keys in place of the same ones of it."""
    both = dict(table)
    for key, value in over.items():
        known = both.get(key)
        both[key] = {**known, **value} if isinstance(known, dict) and isinstance(value, dict) else value
    return both


def config_of(table: Mapping[str, Any], *, name: str | Callable[[str], str]) -> Config:
    """Return the configuration that a parsed file holds.

    Parameters
    ----------
    table
        What the file holds, or several of them merged.
    name
        Stands in messages for the file; of several, what says which one a dotted key comes from.

    Raises
    ------
    companion.errors.ConfigError
        With every fault, one a line.
    """
    try:
        return Config.model_validate(table)
    except ValidationError as error:
        faults = [fault for details in error.errors() for fault in _faults(details, table)]
        named = [(name if isinstance(name, str) else name(key), line) for key, line in faults]
        raise ConfigError("\n".join(f"{place}: {line}" for place, line in named)) from error


def default_toml() -> str:
    """Return a TOML file of all defaults, with meaning, range or choices beside every key."""
    parts = [
        "# Configuration of the void companion. Every key is optional; the values here are the defaults.\n",
        "# Relative paths are relative to this file's folder.\n",
    ]
    for section, schema in section_schemas().items():
        parts.append(f"\n{_comment(schema['description'])}[{section}]\n")
        for key, facts in schema["properties"].items():
            default = toml_value(facts.get("default", []))
            allowed = allowed_values(facts)
            parts.append(
                f"\n{_comment(facts['description'])}"
                f"{_comment(f'Allowed: {allowed}. Default: {default}')}"
                f"{key} = {default}\n"
            )
    return "".join(parts)


def read_text(path: Path, *, noun: str = "configuration") -> str:
    """Read a small text file that a user names; ``noun`` says in messages what it ought to be.

    Raises
    ------
    companion.errors.ConfigError
        When it cannot be read, is too large or is not text.
    """
    try:
        with path.open("rb") as file:
            # One byte more than allowed, and never the whole of an endless device.
            data = file.read(_MAX_FILE_BYTES + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{path}: is a folder; give the {noun} file itself") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{path}: cannot be read: {reason}") from error
    if len(data) > _MAX_FILE_BYTES:
        raise ConfigError(f"{path}: larger than {_MAX_FILE_BYTES} bytes, which no {noun} is")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: not UTF-8 text: byte 0x{data[error.start]:02x} in line {line}") from error


def parse_table(text: str, *, name: str) -> dict[str, Any]:
    """Parse TOML text; ``name`` stands in messages for the file.

    Raises
    ------
    companion.errors.ConfigError
        When it is not TOML.
    """
    try:
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError is one; a number of thousands of digits raises a bare one
        raise ConfigError(f"{name}: not valid TOML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{name}: not valid TOML: nested too deeply") from error


def section_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each section, by its name in the file; keys in the order of the models."""
    schema = Config.model_json_schema()
    return {
        section: schema["$defs"][facts["$ref"].rpartition("/")[2]]
        for section, facts in schema["properties"].items()
    }


def _faults(details: ErrorDetails, table: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the dotted key and one line of each fault, without the file's name."""
    loc = tuple(str(part) for part in details["loc"])
    raised = details.get("ctx", {}).get("error")
    if isinstance(raised, DisagreementError):
        return [
            (
                ".".join((*loc, d.key)),
                f"{_dotted((*loc, *d.key.split('.')))}: found {d.found}; allowed: {d.allowed}",
            )
            for d in raised.disagreements
        ]
    return [(".".join(loc), _fault_line(details, loc, table))]


def _fault_line(details: ErrorDetails, loc: tuple[str, ...], table: Mapping[str, Any]) -> str:
    raised = details.get("ctx", {}).get("error")
    if details["type"] == "extra_forbidden":
        return _unknown_key_line(loc, table)
    found = f"{_dotted(loc)}: found {shown_value(details['input'])}"
    if len(loc) == 1:
        return f"{found}; allowed: a table, [{loc[0]}]"
    if isinstance(raised, ValueError):
        return f"{found}; allowed: {raised}"
    return f"{found}; allowed: {allowed_values(section_schemas()[loc[0]]['properties'][loc[1]])}"


def _unknown_key_line(loc: tuple[str, ...], table: Mapping[str, Any]) -> str:
    schemas = section_schemas()
    key = loc[-1]
    if len(loc) > 1:
        known: Sequence[str] = list(schemas[loc[0]]["properties"])
        line = f"{_dotted(loc)}: unknown key"
    else:
        known = list(schemas)
        line = f"{_dotted(loc)}: unknown {'table' if isinstance(table.get(key), dict) else 'key'}"
    if near := difflib.get_close_matches(key.lower(), known, n=1, cutoff=0.6):
        return f"{line}; did you mean {_dotted((*loc[:-1], near[0]))}?"
    homes = [section for section, schema in schemas.items() if key in schema["properties"]]
    if homes:
        return f"{line}; did you mean {_dotted((homes[0], key))}?"
    return f"{line}; allowed here: {', '.join(known)}"


def allowed_values(facts: Mapping[str, Any]) -> str:
    """Return what a key may hold, in words, from its JSON schema (one without references)."""
    if "const" in facts:
        return f"only {toml_value(facts['const'])}"
    if "enum" in facts:
        return "one of " + ", ".join(toml_value(choice) for choice in facts["enum"])
    if facts.get("type") == "boolean":
        return "true or false"
    if facts.get("type", "string") in ("string", "array"):  # no type: text or a list of it
        if examples := facts.get("examples"):
            return "text such as " + " or ".join(toml_value(example) for example in examples)
        return "text"
    bounds = [
        f"{word} {facts[bound]:g}"
        for bound, word in (
            ("minimum", "from"),
            ("exclusiveMinimum", "above"),
            ("maximum", "up to"),
            ("exclusiveMaximum", "below"),
        )
        if bound in facts
    ]
    noun = "whole number" if facts["type"] == "integer" else "number"
    return f"{noun} {' and '.join(bounds)}" if bounds else noun


def _dotted(loc: Sequence[str]) -> str:
    return ".".join(part if _BARE_KEY.fullmatch(part) else json.dumps(part)[:_MAX_SHOWN] for part in loc)


def shown_value(value: object) -> str:
    """Return what was found in a file, in short, for a message."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, bool | int | float | str):
        text = toml_value(value)
        return text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + "..."
    return f"{value} (a date or time)"


def toml_value(value: bool | float | str | list[str]) -> str:
    """Return one value as TOML writes it."""
    if isinstance(value, list):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)  # a TOML basic string escapes as JSON does
    return repr(value)


def _comment(text: str) -> str:
    lines = textwrap.wrap(text, width=98, break_long_words=False, break_on_hyphens=False)
    return "".join(f"# {line}\n" for line in lines)
