"""The wheel under test and everything it depends on, for the guest's Python."""

from __future__ import annotations

import shutil
import sys
import tomllib
from pathlib import Path
from typing import Final

from vm.errors import VmError, run
from vm.tools import NICE

_GUEST_PYTHON: Final = "3.11"  # Debian 12
_PLATFORMS: Final = (
    "manylinux_2_28_x86_64",
    "manylinux_2_27_x86_64",
    "manylinux_2_17_x86_64",
    "manylinux2014_x86_64",
)


def provide_wheels(project: Path, cache: Path, *, log: Path) -> tuple[Path, str]:
    """Build the project's wheel and fetch what it needs; return the folder with both, and the former's name.

    Parameters
    ----------
    project
        The checkout.
    cache
        Folder of what is kept between runs; wheels that are there already are not fetched again.
    log
        Takes pip's output.

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
    options = ["--only-binary=:all:", "--implementation=cp", f"--python-version={_GUEST_PYTHON}"]
    options += [f"--platform={platform}" for platform in _PLATFORMS]
    source = [f"--find-links={folder}", "-d", str(folder)]
    run([*pip, "download", *options, *source, str(wheels[0])], log=log, what="the wheel's dependencies")
    return folder, wheels[0].name


def _python_with_pip(project: Path) -> str:
    own = project / ".venv/bin/python"
    return str(own) if own.exists() else sys.executable
