"""The settings as a form: every key of the configuration with its meaning, effect, range and unit, from the models (pure)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from companion.config_file import allowed_values, section_schemas
from companion.config_reference import unit_of
from companion.config_reload_rules import WhenChanged, reason_to_restart, when_changed

_EFFECT: Final = re.compile(r"(?:^|(?<=[.;] ))(?=(?:Larger|Smaller|Higher|Lower)\b)")
_UNIT_AT_END: Final = re.compile(r" \((?:deg|deg/s|m|m/s|s|ms|px|Hz|MiB)\)(?=\.?$)")
_BOUNDS: Final = ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum")
_FIRST: Final = ("guidance", "detector", "camera")
"""What is tuned most comes first."""
_KEPT_OUT: Final = (
    "engagement.",
    "web.",
    "status.",
    "link.signing_",
    "ground_station.set_parameters",
    "ground_station.parameters_file",
    "recorder.folder",
    "source.url",  # a GStreamer pipeline in it is a command
)
KEPT_OUT_REASON: Final = (
    "decides who may reach the service, or what it runs and where it writes: change it in the file itself"
)


def is_kept_out(key: str) -> bool:
    """Return whether a dotted key is one that the page shows and never changes."""
    return key.startswith(_KEPT_OUT)


def settings_form() -> list[dict[str, Any]]:
    """Return the tables of the configuration, each with its keys; what is tuned most comes first.

    Returns
    -------
    Of each table ``name``, ``description`` and ``keys``; of each key ``key`` (dotted), ``name``, ``type`` (number, integer,
    boolean, choice, text, list), ``unit``, ``choices``, the bounds as JSON Schema calls them, ``allowed`` in words,
    ``meaning``, ``effect``, ``default``, ``when`` (at once, new worker, restart), ``reason`` why a restart, and ``kept_out``.
    """
    schemas = section_schemas()
    order = sorted(schemas, key=lambda name: _FIRST.index(name) if name in _FIRST else len(_FIRST))
    return [
        {
            "name": section,
            "description": schemas[section].get("description", ""),
            "keys": [
                _entry(f"{section}.{name}", facts) for name, facts in schemas[section]["properties"].items()
            ],
        }
        for section in order
    ]


def _entry(key: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    meaning, effect = split_effect(str(facts.get("description", "")))
    when = when_changed(key)
    entry: dict[str, Any] = {
        "key": key,
        "name": key.partition(".")[2],
        "type": _type(facts),
        "unit": unit_of(key),
        "allowed": allowed_values(facts),
        "meaning": meaning,
        "effect": effect,
        "default": facts.get("default"),
        "when": when.value,
        "kept_out": is_kept_out(key),
    }
    if "enum" in facts:
        entry["choices"] = list(facts["enum"])
    if when is WhenChanged.RESTART:
        entry["reason"] = reason_to_restart(key)
    entry.update({bound: facts[bound] for bound in _BOUNDS if bound in facts})
    return entry


def split_effect(description: str) -> tuple[str, str]:
    """Return what a key means, and what larger or smaller values do; the unit is told apart."""
    parts = _EFFECT.split(description, maxsplit=1)
    meaning = _UNIT_AT_END.sub("", parts[0].strip())
    effect = _UNIT_AT_END.sub("", parts[1].strip()) if len(parts) > 1 else ""
    return meaning, effect


def _type(facts: Mapping[str, Any]) -> str:
    if "enum" in facts:
        return "choice"
    kind = facts.get("type")
    if kind in ("number", "integer", "boolean"):
        return str(kind)
    return "text" if kind == "string" else "list"
