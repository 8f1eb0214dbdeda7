"""What the guest found, one JSON line a check, where the host can read it at once."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

RESULTS = Path("/mnt/results")


class CheckFailedError(Exception):
    """A check that did not hold; the message says what was found."""


class CheckSkippedError(Exception):
    """A check that cannot be made here; the message says why."""


def check(name: str, body: Callable[[], str]) -> bool:
    """Run one check and write its result.

    Parameters
    ----------
    name
        Its name in the table.
    body
        Does it, and returns what it found in a few words.

    Returns
    -------
    bool
        Whether it passed.
    """
    started_s = time.monotonic()
    try:
        outcome, detail = "PASS", body()
    except CheckFailedError as error:
        outcome, detail = "FAIL", str(error)
    except CheckSkippedError as error:
        outcome, detail = "SKIP", str(error)
    except Exception as error:  # noqa: BLE001  one check that breaks must not keep the others from being made
        outcome, detail = "FAIL", f"{type(error).__name__}: {error}"
    write(name, outcome, detail, time.monotonic() - started_s)
    return outcome == "PASS"


def write(name: str, outcome: str, detail: str, seconds: float) -> None:
    """Append one line to the results."""
    line = json.dumps(
        {"check": name, "outcome": outcome, "detail": " ".join(detail.split()), "seconds": seconds}
    )
    with (RESULTS / "results.jsonl").open("a") as file:
        file.write(line + "\n")
    print(f"vm-check: {outcome} {name}: {detail}", flush=True)


def require(condition: bool, found: str) -> None:
    """Fail the check with what was found when the condition does not hold."""
    if not condition:
        raise CheckFailedError(found)
