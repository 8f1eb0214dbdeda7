"""What is said of the keys: complete for every one, the same on the page as in the models, and usable by editors."""

from __future__ import annotations

import json
import re
from pathlib import Path

from companion.cli import main
from companion.config_file import allowed_values, section_schemas
from companion.config_reference import json_schema, reference_markdown, unit_of

PAGE = Path(__file__).parents[2] / "docs/configuration-reference.md"
KEYS = [
    (section, key, facts)
    for section, schema in section_schemas().items()
    for key, facts in schema["properties"].items()
]
EFFECT = re.compile(r"\b(larger|smaller|higher|lower|more|less)\b", re.IGNORECASE)
NUMBERS_THAT_ARE_NAMES = {
    "link.component_id",
    "link.planner_system_id",
    "link.planner_component_id",
    "link.signing_link_id",
    "engagement.rc_channel",
    "web.port",
    "web.max_clients",
}
"""Ids, channels and ports: another one is another one, not more or less. A limit of viewers says what a further one is told."""
UNIT_BY_NAME = re.compile(r"_(?:deg_s|m_s|deg|px|ms|hz|m|s)$")


def test_the_page_is_the_one_that_the_models_make():
    assert PAGE.read_text(encoding="utf-8") == reference_markdown(), (
        "run: companion config --reference > docs/configuration-reference.md"
    )


def faults_of(key: str, facts: dict) -> list[str]:
    faults = []
    if len(facts["description"]) <= 20:
        faults.append(f"{key}: what it means")
    if not allowed_values(facts) or "default" not in facts:
        faults.append(f"{key}: what is allowed, and the default")
    if facts.get("type") in ("number", "integer"):
        least, most = {"minimum", "exclusiveMinimum"}, {"maximum", "exclusiveMaximum"}
        if not (least & facts.keys() and most & facts.keys()):
            faults.append(f"{key}: from where to where")
        if key not in NUMBERS_THAT_ARE_NAMES and not EFFECT.search(facts["description"]):
            faults.append(f"{key}: what a larger or a smaller value does")
        if UNIT_BY_NAME.search(key) and not unit_of(key):
            faults.append(f"{key}: its unit")
    return faults


def test_every_key_has_meaning_unit_range_default_and_effect():
    assert [fault for section, key, facts in KEYS for fault in faults_of(f"{section}.{key}", facts)] == []
    assert len(KEYS) > 100


def test_a_key_that_says_too_little_is_noticed():
    assert len(faults_of("guidance.new_m", {"type": "number", "description": "x", "default": 1.0})) == 3


def test_the_schema_knows_every_key_and_no_other(capsys):
    assert main(["config", "--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert schema == json_schema()
    assert schema["additionalProperties"] is False
    for section, facts in schema["properties"].items():
        table = schema["$defs"][facts["$ref"].rpartition("/")[2]]
        assert table["additionalProperties"] is False
        assert {key for s, key, _ in KEYS if s == section} == table["properties"].keys()


def test_the_command_prints_the_page(capsys):
    assert main(["config", "--reference"]) == 0
    assert capsys.readouterr().out == reference_markdown()
