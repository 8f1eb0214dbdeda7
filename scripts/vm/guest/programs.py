"""Running programs in the guest, with everything they say kept for the host."""

from __future__ import annotations

import subprocess
from pathlib import Path

from report import RESULTS, CheckFailedError

VENV = Path("/opt/void-companion")
PYTHON = str(VENV / "bin/python")
_KEPT_CHARACTERS = 4000
COMPANION = str(VENV / "bin/companion")


def run(*words: str, limit_s: float = 120.0, codes: tuple[int, ...] = (0,)) -> str:
    """Return what a program printed.

    Parameters
    ----------
    words
        Program and arguments.
    limit_s
        It is killed, and the check fails, after this time.
    codes
        Exit codes that are expected.

    Raises
    ------
    CheckFailedError
        When it ends with another code or not in time.
    """
    shown = " ".join(words)
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, errors="replace", timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise CheckFailedError(f"{shown}: not done within {limit_s:.0f} s") from error
    with (RESULTS / "programs.log").open("a") as log:
        said = done.stdout + done.stderr
        log.write(f"$ {shown}\n{said[-_KEPT_CHARACTERS:]}[{done.returncode}]\n")
    if done.returncode not in codes:
        said = (done.stderr or done.stdout).strip().splitlines() or ["it said nothing"]
        raise CheckFailedError(f"{shown}: code {done.returncode}: {said[-1]}")
    return done.stdout
