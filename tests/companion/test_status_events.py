"""Every event of the log is listed in docs/events.md with the levels that it has, and nothing else is."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
LEVEL_OF = {
    "debug": "debug",
    "info": "info",
    "warning": "warning",
    "error": "error",
    "exception": "error",
    "critical": "critical",
    "log": "as the library says",
}
LOGGERS = ("log", "_log")
NAME = re.compile(r"[a-z][a-z0-9_]*")


def events_in(source: str) -> dict[str, set[str]]:
    """Levels by name of the events that a module logs."""
    found: dict[str, set[str]] = defaultdict(set)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner = ast.unparse(node.func.value).rpartition(".")[2]
            if owner in LOGGERS and node.func.attr in LEVEL_OF:
                name = node.args[node.func.attr == "log"]
                assert isinstance(name, ast.Constant), f"an event without a fixed name: {ast.unparse(node)}"
                found[name.value].add(LEVEL_OF[node.func.attr])
        if isinstance(node, ast.Dict):  # an event that is made without a logger
            fields = {
                ast.unparse(key): value.value
                for key, value in zip(node.keys, node.values, strict=True)
                if key is not None and isinstance(value, ast.Constant)
            }
            if {"'event'", "'level'"} <= fields.keys():
                found[fields["'event'"]].add(fields["'level'"])
    return found


@cache
def events_of_the_code() -> dict[str, set[str]]:
    found: dict[str, set[str]] = defaultdict(set)
    for path in sorted((ROOT / "companion").rglob("*.py")):
        if "sim" not in path.relative_to(ROOT / "companion").parts:
            for name, levels in events_in(path.read_text(encoding="utf-8")).items():
                found[name] |= levels
    return found


def listed_events() -> dict[str, set[str]]:
    rows = re.findall(
        r"^\| `([^`]+)` \| ([^|]+) \| ([^|]+) \|", (ROOT / "docs/events.md").read_text(), re.MULTILINE
    )
    names = [name for name, _, _ in rows]
    assert len(names) == len(set(names)), "an event is listed twice"
    assert all(says.strip() for _, _, says in rows)
    return {name: set(level.split(", ")) for name, level, _ in rows}


def test_every_event_is_listed_and_every_listed_one_exists():
    code, page = events_of_the_code(), listed_events()
    assert len(code) > 50, "hardly any found: is the log called otherwise by now?"
    assert {name for name in code if not NAME.fullmatch(name)} == set()
    assert sorted(code.keys() - page.keys()) == [], "logged, and not in docs/events.md"
    assert sorted(page.keys() - code.keys()) == [], "in docs/events.md, and logged nowhere"


def test_the_levels_are_those_of_the_code():
    code, page = events_of_the_code(), listed_events()
    assert {name: page[name] for name in page if page[name] != code[name]} == {}


def test_a_new_event_is_noticed():
    assert events_in('self._log.exception("new_event", x=1)\nlog.info("other")') == {
        "new_event": {"error"},
        "other": {"info"},
    }
    assert events_in('event = {"event": "made", "level": "warning", "lines": 3}') == {"made": {"warning"}}
    assert events_in('math.log(3)\nparser.error("no event")') == {}
