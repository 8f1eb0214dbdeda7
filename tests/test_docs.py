"""The documentation holds together: links and anchors lead somewhere, every page is in the navigation, and what it names exists."""

from __future__ import annotations

import ast
import contextlib
import io
import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

import pytest
from markdown_it import MarkdownIt  # comes with rich
from markdown_it.token import Token

from companion.cli import main as companion_main
from companion.config import Config
from companion.doctor.autopilot_facts import facts
from companion.mavlink.telemetry import MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4
from detector.cli import main as detector_main
from detector.results import NoDetectionReason

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SITE_PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
OTHER_PAGES = sorted(
    page
    for folder in ("benchmarks", "companion", "detector", "scripts", "systemd", "tests")
    for page in (ROOT / folder).rglob("*.md")
)
_GITHUB_DROPS = re.compile(r"[^\w\- ]")
_TOCTREE = re.compile(r"^(?:.*<(?P<named>[^>]+)>|(?P<bare>\S+))$")
_SETTING = re.compile(r"(?P<table>[a-z_]+)\.(?P<key>[a-z_]+)(?: = .*)?")
_COMMAND = re.compile(
    r"^\s*(?:[A-Z_]+=\S+ |sudo )*(?:\S*/)?(?P<program>companion|detector) (?P<command>[a-z][a-z-]*)\b(?!\.)"
)


class Link(NamedTuple):
    """Where a page points to: of a picture or a link, as it is written."""

    page: Path
    target: str


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def _tokens_of(text: str) -> list[Token]:
    return MarkdownIt("commonmark").enable("table").parse(text)


@cache
def _tokens(page: Path) -> tuple[Token, ...]:
    return tuple(_tokens_of(page.read_text(encoding="utf-8")))


def _inline(page: Path) -> Iterator[Token]:
    for token in _tokens(page):
        yield from token.children or ()


def _links(page: Path) -> Iterator[Link]:
    for token in _inline(page):
        target = token.attrs.get("href") or token.attrs.get("src")
        if target:
            yield Link(page, str(target))


def _slugs(tokens: tuple[Token, ...]) -> set[str]:
    """Return the anchors of a page's headings, made as GitHub and the site make them."""
    seen: Counter[str] = Counter()
    slugs = set()
    for number, token in enumerate(tokens):
        if token.type != "heading_open":
            continue
        words = "".join(
            child.content
            for child in tokens[number + 1].children or ()
            if child.type in ("text", "code_inline")
        )
        slug = _GITHUB_DROPS.sub("", words.lower()).replace(" ", "-")
        slugs.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return slugs


def broken(link: Link) -> str | None:
    """Return what is wrong with a link, or None. Addresses of the web are not tried."""
    parts = urlsplit(link.target)
    if parts.scheme or parts.netloc:
        return None
    target = (link.page.parent / unquote(parts.path)).resolve() if parts.path else link.page
    if not target.is_relative_to(ROOT):
        return "leads out of the checkout"
    if not target.exists():
        return "there is no such file"
    if parts.fragment and target.suffix == ".md" and parts.fragment not in _slugs(_tokens(target)):
        return f"{_name(target)} has no heading of that name"
    return None


def _navigation() -> list[Path]:
    pages = []
    for token in _tokens(DOCS / "index.md"):
        if token.type != "fence" or token.info.strip() != "{toctree}":
            continue
        for line in filter(None, map(str.strip, token.content.splitlines())):
            entry = _TOCTREE.match(line)
            if entry is None or line.startswith(":"):
                continue
            pages.append((DOCS / f"{entry['named'] or entry['bare']}.md").resolve())
    return pages


@pytest.mark.parametrize("page", [*SITE_PAGES, *OTHER_PAGES], ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    assert [f"{link.target}: {why}" for link in _links(page) if (why := broken(link))] == []


@pytest.mark.parametrize(
    ("target", "why"),
    [
        ("docs/nowhere.md", "no such file"),
        ("docs/configuration.md#no-such-heading", "no heading"),
        ("#no-such-heading", "no heading"),
        ("../elsewhere.md", "out of the checkout"),
    ],
)
def test_a_broken_link_is_noticed(target: str, why: str) -> None:
    assert why in (broken(Link(ROOT / "README.md", target)) or "")


def test_anchors_are_those_of_the_site() -> None:
    page = _tokens_of("# A `b.c`: d, e-f\n\n## Twice\n\n## Twice\n")
    assert _slugs(tuple(page)) == {"a-bc-d-e-f", "twice", "twice-1"}


def test_every_page_is_in_the_navigation_once() -> None:
    listed = Counter(_navigation())
    assert sorted(listed) == sorted({page for page in SITE_PAGES if page != DOCS / "index.md"})
    assert [_name(page) for page, times in listed.items() if times > 1] == []


@pytest.mark.parametrize(
    "page", [page for page in SITE_PAGES if page.name not in ("CHANGELOG.md", "ARCHITECTURE.md")], ids=_name
)
def test_settings_that_are_named_exist(page: Path) -> None:
    wrong = []
    for token in _inline(page):
        setting = _SETTING.fullmatch(token.content) if token.type == "code_inline" else None
        if setting is not None and not _is_setting(setting["table"], setting["key"]):
            wrong.append(token.content)
    assert wrong == []


def _is_setting(table: str, key: str) -> bool:
    if table not in Config.model_fields:
        return True  # not of the configuration at all
    names_a_module = (ROOT / table / f"{key}.py").exists() or key in ("py", "toml", "png")
    section = Config.model_fields[table].annotation
    return names_a_module or key in getattr(section, "model_fields", {})


@pytest.mark.parametrize("page", SITE_PAGES, ids=_name)
def test_commands_that_are_named_exist(page: Path) -> None:
    lines = [
        line
        for token in (*_tokens(page), *_inline(page))
        if token.type in ("code_inline", "code_block") or (token.type == "fence" and "{" not in token.info)
        for line in token.content.splitlines()
    ]
    wrong = [
        line
        for line in lines
        for found in [_COMMAND.search(line)]
        if found and not _is_command(**found.groupdict())
    ]
    assert wrong == []


def _is_command(program: str, command: str) -> bool:
    return command in _commands(program)


@cache
def _commands(program: str) -> frozenset[str]:
    mains: dict[str, Callable[[list[str]], int]] = {"companion": companion_main, "detector": detector_main}
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        mains[program](["--help"])
    return frozenset(re.findall(r"^    ([a-z][a-z-]*)\b", shown.getvalue(), re.MULTILINE))


# ---------------------------------------------------------------- troubleshooting knows every reason


@cache
def _explained() -> frozenset[str]:
    """Return what stands in code marks on the page of symptoms; an ellipsis stands for what differs from case to case."""
    tokens = _inline(DOCS / "troubleshooting.md")
    return frozenset(token.content for token in tokens if token.type == "code_inline")


def _is_explained(words: str) -> bool:
    patterns = (re.escape(entry).replace(r"\.\.\.", ".*") for entry in _explained())
    return any(re.fullmatch(pattern, words) for pattern in patterns)


def _tree(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text(encoding="utf-8"))


def _words(node: ast.expr | None, names: dict[str, str]) -> str | None:
    match node:
        case ast.Constant(value=str(words)):
            return words
        case ast.Name(id=name):
            return names.get(name)
        case ast.JoinedStr(values=parts) if any(isinstance(part, ast.Constant) for part in parts):
            return "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in parts)
        case ast.BoolOp(values=[*_, last]):
            return _words(last, names)
    return None


def _texts(tree: ast.Module) -> dict[str, str]:
    return {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def _reasons_of_states() -> Iterator[str]:
    """Yield the reason of every `State.X, "reason"`, whether returned or entered."""
    for file in ("companion/guidance/table.py", "companion/guidance/substitution.py"):
        tree = _tree(file)
        names = _texts(tree)
        for node in ast.walk(tree):
            pairs = (
                node.elts
                if isinstance(node, ast.Tuple)
                else node.args[:2]
                if isinstance(node, ast.Call)
                else []
            )
            if len(pairs) == 2 and ast.unparse(pairs[0]).startswith("State."):
                words = _words(pairs[1], names)
                if words:
                    yield words


def _returned_by(file: str, function: str) -> Iterator[str]:
    """Yield the words that a function returns, alone or as the last of a tuple."""
    tree = _tree(file)
    names = _texts(tree)
    for found in ast.walk(tree):
        if not isinstance(found, ast.FunctionDef) or found.name != function:
            continue
        for node in ast.walk(found):
            if isinstance(node, ast.Return):
                value = node.value.elts[-1] if isinstance(node.value, ast.Tuple) else node.value
                words = _words(value, names)
                if words:
                    yield words


def _second_words(file: str, called: str) -> Iterator[str]:
    """Yield the second argument, where it is text, of every call of that name."""
    for node in ast.walk(_tree(file)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == called and len(node.args) > 1:
            words = _words(node.args[1], {})
            if words:
                yield words


def _first_words(file: str, called: str) -> Iterator[str]:
    for node in ast.walk(_tree(file)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == called and node.args:
            words = _words(node.args[0], {})
            if words:
                yield words


REASONS = {
    "states": _reasons_of_states,
    "missing inputs": lambda: _returned_by("companion/guidance/substitution.py", "not_ready"),
    "answers used up": lambda: _returned_by("companion/guidance/situation.py", "_good_answer"),
    "walls": lambda: iter(("wall ahead", "no way ahead")),
    "the detector": lambda: (str(reason) for reason in NoDetectionReason),
    "takeover": lambda: _second_words("companion/guidance/takeover.py", "self._to"),
    "the mission": lambda: _returned_by("companion/guidance/mission_goal.py", "place"),
    "setpoints not understood": lambda: _first_words("companion/guidance/dialect.py", "NotUnderstood"),
    "setpoints that pass": lambda: _first_words("companion/interception.py", "Unprotected"),
    "setpoints that are dropped": lambda: _first_words("companion/interception.py", "Drop"),
    "signatures": lambda: _returned_by("companion/mavlink/signing.py", "verify"),
    "the doctor": lambda: _first_words("companion/doctor/checks.py", "Check"),
    "the doctor's parameters": lambda: (
        fact.name
        for autopilot in (MAV_AUTOPILOT_PX4, MAV_AUTOPILOT_ARDUPILOTMEGA)
        for fact in facts(autopilot)
    ),
}


@pytest.mark.parametrize("source", REASONS)
def test_every_reason_that_is_announced_is_explained(source: str) -> None:
    reasons = set(REASONS[source]())
    assert reasons, "nothing found: has the code that says them moved?"
    assert sorted(words for words in reasons if not _is_explained(words)) == []
