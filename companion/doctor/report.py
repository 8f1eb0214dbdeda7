"""The checklist for people and for programs (pure)."""

from __future__ import annotations

import json
from collections.abc import Sequence

from companion.doctor.check import Check, Level

_MARKS = {Level.OK: " ok ", Level.WARN: "WARN", Level.FAIL: "FAIL"}


def exit_code(checks: Sequence[Check]) -> int:
    """Return 1 where anything failed, else 0."""
    return int(any(check.level is Level.FAIL for check in checks))


def as_text(checks: Sequence[Check]) -> str:
    """Return one line a check, and under it what to do."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"[{_MARKS[check.level]}] {check.name:<{width}}  {check.found}")
        if check.advice:
            lines.append(f"{'':7}{'':<{width}}  -> {check.advice}")
    failed = sum(check.level is Level.FAIL for check in checks)
    warned = sum(check.level is Level.WARN for check in checks)
    lines.append(f"{len(checks)} checks: {failed} failed, {warned} to look at")
    return "\n".join(lines) + "\n"


def as_json(checks: Sequence[Check]) -> str:
    """Return one JSON object: ``ok``, and ``checks`` with name, level, found and advice."""
    return (
        json.dumps(
            {
                "ok": exit_code(checks) == 0,
                "checks": [
                    {
                        "name": check.name,
                        "level": str(check.level),
                        "found": check.found,
                        "advice": check.advice,
                    }
                    for check in checks
                ],
            },
            indent=2,
        )
        + "\n"
    )
