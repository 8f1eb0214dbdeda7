"""Worlds from TOML files, the built-in ones among them: read strictly, every fault a line of its own."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from companion.config import DisagreementError
from companion.config_file import allowed_values, parse_table, read_text, shown_value
from companion.errors import ConfigError
from companion.sim.world.clearance import VEHICLE_RADIUS_M, Obstacles
from companion.sim.world.model import World

_SUFFIX: Final = ".toml"
_Schema = Mapping[str, Any]


def builtin_worlds() -> tuple[str, ...]:
    """Return the names of the built-in worlds, in alphabetical order."""
    names = (entry.name for entry in _builtin_folder().iterdir())
    return tuple(sorted(name.removesuffix(_SUFFIX) for name in names if name.endswith(_SUFFIX)))


def load_world(name_or_path: str | Path) -> World:
    """Read a world.

    Parameters
    ----------
    name_or_path
        Name of a built-in world, or path of a TOML file. Text that ends in ``.toml`` or has a slash is a path.

    Raises
    ------
    companion.errors.ConfigError
        With every fault of the file, one a line: file, key, what was found, what is allowed.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(_SUFFIX) or "/" in text or "\\" in text:
        return parse_world(read_text(Path(name_or_path), noun="world"), name=text)
    if text not in (names := builtin_worlds()):
        near = difflib.get_close_matches(text.lower(), names, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]}?" if near else f"allowed: a {_SUFFIX} file, or {', '.join(names)}"
        raise ConfigError(f"world: found {shown_value(text)}; {hint}")
    return parse_world((_builtin_folder() / f"{text}{_SUFFIX}").read_text("utf-8"), name=text + _SUFFIX)


def parse_world(text: str, *, name: str = "world") -> World:
    """Read a world from TOML text; ``name`` stands in messages for the file.

    Raises
    ------
    companion.errors.ConfigError
        With every fault of the text, one a line.
    """
    table = parse_table(text, name=name)
    try:
        world = World.model_validate(table)
    except ValidationError as error:
        schema = World.model_json_schema()
        lines = [line for details in error.errors() for line in _fault_lines(details, schema)]
        raise ConfigError("\n".join(f"{name}: {line}" for line in lines)) from error
    if lines := _standing_faults(world):
        raise ConfigError("\n".join(f"{name}: {line}" for line in lines))
    return world


def _builtin_folder() -> Traversable:
    return resources.files("companion.sim.world") / "builtin"


def _standing_faults(world: World) -> list[str]:
    """Return what keeps the vehicle from being where the flight begins or ends."""
    obstacles = Obstacles.of(world)
    faults = []
    for key, place in (("start", world.start), ("goal", world.goal)):
        clearance_m = obstacles.clearance_m((place.north_m, place.east_m, -place.height_m))
        if clearance_m <= 0.0:
            faults.append(
                f"{key}: found {clearance_m + VEHICLE_RADIUS_M:.2f} m from the nearest thing; "
                f"allowed: room for a vehicle of {VEHICLE_RADIUS_M:g} m radius"
            )
    return faults


def _fault_lines(details: ErrorDetails, root: _Schema) -> list[str]:
    """Return one line a fault, without the file's name."""
    loc = details["loc"]
    raised = details.get("ctx", {}).get("error")
    if isinstance(raised, DisagreementError):
        return [
            f"{_joined(_dotted(loc), d.key)}: found {d.found}; allowed: {d.allowed}"
            for d in raised.disagreements
        ]
    if details["type"] == "extra_forbidden":
        return [_unknown_key_line(loc, root)]
    found = "nothing" if details["type"] == "missing" else shown_value(details["input"])
    allowed = str(raised) if isinstance(raised, ValueError) else _allowed(_facts(loc, root), loc)
    return [f"{_dotted(loc)}: found {found}; allowed: {allowed}"]


def _unknown_key_line(loc: tuple[int | str, ...], root: _Schema) -> str:
    known = list(_facts(loc[:-1], root)["properties"])
    line = f"{_dotted(loc)}: unknown key"
    if near := difflib.get_close_matches(str(loc[-1]).lower(), known, n=1, cutoff=0.6):
        return f"{line}; did you mean {_dotted((*loc[:-1], near[0]))}?"
    return f"{line}; allowed here: {', '.join(known)}"


def _facts(loc: tuple[int | str, ...], root: _Schema) -> _Schema:
    """Return the schema of the value at a place in the file, without references."""
    facts: _Schema = root
    for part in loc:
        if isinstance(part, str):
            facts = facts["properties"][part]
        else:
            facts = facts["prefixItems"][part] if "prefixItems" in facts else facts["items"]
        facts = facts["anyOf"][0] if "anyOf" in facts else facts
        if "$ref" in facts:
            facts = root["$defs"][facts["$ref"].rpartition("/")[2]]
    return facts


def _allowed(facts: _Schema, loc: tuple[int | str, ...]) -> str:
    if "properties" in facts:
        return f"a table with {', '.join(facts.get('required', facts['properties']))}"
    if "prefixItems" in facts:
        return f"{len(facts['prefixItems'])} numbers, {facts['description'].removesuffix('.')}"
    if "items" in facts:
        return f"tables, [[{'.'.join(str(part) for part in loc if isinstance(part, str))}]], at most 500"
    if facts["type"] == "string" and "maxLength" in facts:
        return f"text of at most {facts['maxLength']} characters"
    return allowed_values(facts)


def _dotted(loc: tuple[int | str, ...]) -> str:
    """Return a place in the file as people write it, such as ``walls[0].openings[1].at_m``."""
    text = ""
    for part in loc:
        text = f"{text}[{part}]" if isinstance(part, int) else _joined(text, part[:60])
    return text


def _joined(table: str, key: str) -> str:
    return f"{table}.{key}" if table else key
