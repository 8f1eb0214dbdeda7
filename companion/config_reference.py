"""The configuration explained to editors and to people: JSON Schema and the reference page, both from the models (pure)."""

from __future__ import annotations

from typing import Any, Final

from companion.config import Config
from companion.config_file import allowed_values, section_schemas, toml_value
from companion.config_reload_rules import WhenChanged, when_changed

_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_UNITS: Final = (
    ("_deg_s", "deg/s"),
    ("_m_s", "m/s"),
    ("_deg", "deg"),
    ("_px", "px"),
    ("_ms", "ms"),
    ("_hz", "Hz"),
    ("_m", "m"),
    ("_s", "s"),
)
_HEAD: Final = """# Configuration reference

Made by `companion config --reference` from the models that read the file; a test holds this page against them. How to set values, and which
place wins: [configuration.md](configuration.md).

**When** says what a changed value does while the service runs (SIGHUP, or the file is saved): *at once*, *new worker* (the vision worker is
started anew, the vehicle holds meanwhile), or *restart* (kept out, announced with the reason, acts with the next start).
"""
_WHEN_WORDS: Final = {
    WhenChanged.AT_ONCE: "at once",
    WhenChanged.NEW_WORKER: "new worker",
    WhenChanged.RESTART: "restart",
}


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration file, for editors that check and complete TOML."""
    return {"$schema": _DIALECT, **Config.model_json_schema(), "title": "void-companion configuration"}


def unit_of(key: str) -> str:
    """Return the unit that a key's name ends in; "" where it has none."""
    return next((unit for suffix, unit in _UNITS if key.endswith(suffix)), "")


def reference_markdown() -> str:
    """Return the reference page: a table of keys for each table of the file."""
    parts = [_HEAD]
    for section, schema in section_schemas().items():
        parts.append(f"\n## `[{section}]`\n\n{_cell(schema['description'])}\n\n")
        parts.append("| key | meaning | unit | allowed | default | when |\n|---|---|---|---|---|---|\n")
        for key, facts in schema["properties"].items():
            cells = (
                f"`{key}`",
                _cell(facts["description"]),
                unit_of(key),
                _cell(allowed_values(facts)),
                f"`{_cell(toml_value(facts.get('default', [])))}`",
                _WHEN_WORDS[when_changed(f"{section}.{key}")],
            )
            parts.append(f"| {' | '.join(cells)} |\n")
    return "".join(parts)


def _cell(text: str) -> str:
    """Return a text as one cell of a table."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
