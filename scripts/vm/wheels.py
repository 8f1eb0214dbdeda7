"""The project's wheel and everything it depends on, for another machine's Python."""

from __future__ import annotations

import shutil
import sys
import tomllib
from pathlib import Path
from typing import Final

from vm.errors import VmError, run
from vm.tools import NICE

DEBIAN_12_PYTHON: Final = "3.11"
EXTRAS: Final = ("web", "fast")
"""What `install.sh` installs besides: the live page, which is switched on by the configuration alone, and a quicker event loop."""
OPTIONAL_EXTRAS: Final = frozenset({"fast"})
"""Of these, what it does without where there is no wheel for the machine."""
_GLIBC: Final = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")


def provide_wheels(
    project: Path, cache: Path, *, log: Path, python_version: str = DEBIAN_12_PYTHON, machine: str = "x86_64"
) -> tuple[Path, str]:
    """Build the project's wheel and fetch what it needs; return the folder with both, and the former's name.

    Parameters
    ----------
    project
        The checkout.
    cache
        Folder of what is kept between runs; wheels that are there already are not fetched again.
    log
        Takes pip's output.
    python_version, machine
        What they are for, such as 3.11 and aarch64.

    Raises
    ------
    VmError
        When the wheel cannot be built or a dependency cannot be had.
    """
    pip = [*NICE, _python_with_pip(project), "-m", "pip", "--quiet", "--disable-pip-version-check"]
    built = cache / "built"
    shutil.rmtree(built, ignore_errors=True)
    run([*pip, "wheel", "--no-deps", "-w", str(built), str(project)], log=log, what="the wheel")
    wheels = list(built.glob("*.whl"))
    if len(wheels) != 1:
        raise VmError(f"one wheel was expected in {built}, found {len(wheels)}; the log: {log}")
    folder = cache / "wheels"
    folder.mkdir(exist_ok=True)
    name = tomllib.loads((project / "pyproject.toml").read_text())["project"]["name"].replace("-", "_")
    for old in folder.glob(f"{name}-*.whl"):
        old.unlink()
    options = ["--only-binary=:all:", "--implementation=cp", f"--python-version={python_version}"]
    options += [f"--platform={glibc}_{machine}" for glibc in _GLIBC]
    source = [f"--find-links={folder}", "-d", str(folder)]
    for extra in EXTRAS:
        try:
            run(
                [*pip, "download", *options, *source, f"{wheels[0]}[{extra}]"],
                log=log,
                what=f"the wheel's dependencies with the extra {extra}",
            )
        except VmError as error:
            if extra not in OPTIONAL_EXTRAS:
                raise
            sys.stderr.write(f"without the extra {extra}: {error}\n")
    return folder, wheels[0].name


def _python_with_pip(project: Path) -> str:
    own = project / ".venv/bin/python"
    return str(own) if own.exists() else sys.executable
