"""What can keep the virtual machine from being tried."""

from __future__ import annotations

import subprocess
from pathlib import Path


class VmError(Exception):
    """The virtual machine cannot be made or did not finish; the message is one line for the user."""


def run(
    words: list[str],
    *,
    log: Path,
    what: str,
    environment: dict[str, str] | None = None,
    folder: Path | None = None,
) -> None:
    """Run a program with its output in ``log``.

    Parameters
    ----------
    words
        Program and arguments.
    log
        Everything it writes is appended here.
    what
        What it is for, for the message: "debootstrap", "the wheel".
    environment
        Its environment; None for ours.
    folder
        Where it runs; None for here.

    Raises
    ------
    VmError
        When it is not there or fails; with its last line.
    """
    with log.open("ab") as output:
        try:
            done = subprocess.run(
                words,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment,
                cwd=folder,
                check=False,
            )
        except OSError as error:
            raise VmError(f"{what}: {words[0]} cannot be run: {error.strerror}") from error
    if done.returncode:
        lines = log.read_text(errors="replace").strip().splitlines() or ["it said nothing"]
        raise VmError(
            f"{what}: {words[0]} failed with code {done.returncode} ({lines[-1]}); all of it: {log}"
        )
