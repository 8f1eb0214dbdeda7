"""``scripts/deb``: a Debian package of the service.

It carries wheels, ours and those of the dependencies as they are published, licences and all, and makes the virtual
environment on the machine that it is installed on, by ``install.sh`` and without a network. So nothing is repacked, and
what is under the LGPL (pymavlink, parts of OpenCV's wheel) can be replaced by its user as that licence asks.
"""

from __future__ import annotations

import argparse
import email.parser
import platform
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path
from typing import Final

from vm.errors import VmError, run
from vm.wheels import provide_wheels

_PROJECT: Final = Path(__file__).resolve().parents[2]
_NAME: Final = "void-companion"
_HOME: Final = f"usr/lib/{_NAME}"
_ARCHITECTURES: Final = {"x86_64": "amd64", "aarch64": "arm64"}

_CONTROL: Final = """\
Package: {name}
Version: {version}
Architecture: {architecture}
Maintainer: {maintainer}
Installed-Size: {installed_kb}
Depends: python3 (>= {python}), python3 (<< {next_python}), python3-venv, systemd, udev, passwd
Section: misc
Priority: optional
Description: {description}
 Sits between a planner and an autopilot on MAVLink, looks through one camera, and
 keeps the vehicle flying toward open space. Installs a systemd service; its settings
 are in /etc/{name}/config.toml.
"""
_POSTINST: Final = f"""\
#!/bin/sh
set -e
if [ "$1" = configure ]; then
    /{_HOME}/install.sh --wheels /{_HOME}/wheels
fi
"""
_PRERM: Final = f"""\
#!/bin/sh
set -e
if [ "$1" = remove ]; then
    /{_HOME}/install.sh --uninstall --keep-config
fi
"""
_POSTRM: Final = f"""\
#!/bin/sh
set -e
if [ "$1" = purge ]; then
    rm -rf /etc/{_NAME}
fi
"""


def main() -> int:
    """Build it and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/deb", description=__doc__.partition("\n")[0].replace("``", "")
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("dist"), metavar="DIR", help="folder for it (default: dist)"
    )
    parser.add_argument(
        "--python", default="3.11", help="Python of the machine it is for (default: %(default)s)"
    )
    parser.add_argument(
        "--machine", choices=sorted(_ARCHITECTURES), default=platform.machine(), help="default: this one's"
    )
    arguments = parser.parse_args()
    try:
        print(build(arguments.output, python=arguments.python, machine=arguments.machine))
    except (VmError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def build(output: Path, *, python: str, machine: str) -> Path:
    """Build the package and return its file.

    Parameters
    ----------
    output
        Folder for it; made where it does not exist.
    python
        Version of the Python that it is for, such as 3.11.
    machine
        As ``uname -m`` says it.

    Raises
    ------
    VmError
        When a wheel cannot be had or ``dpkg-deb`` is not there.
    """
    major, _, minor = python.partition(".")
    if not (major.isdecimal() and minor.isdecimal()):
        raise VmError(f"--python: found {python!r}; allowed: MAJOR.MINOR, such as 3.11")
    if shutil.which("dpkg-deb") is None:
        raise VmError("dpkg-deb is not there: Debian packages are built on Debian or one of its kin")
    output.mkdir(parents=True, exist_ok=True)
    about = tomllib.loads((_PROJECT / "pyproject.toml").read_text())["project"]
    architecture = _ARCHITECTURES[machine]
    with tempfile.TemporaryDirectory(prefix="deb-", dir=output) as scratch:
        work = Path(scratch)
        log = work / "log"
        wheels, _ = provide_wheels(_PROJECT, work, log=log, python_version=python, machine=machine)
        root = work / "root"
        home = root / _HOME
        home.mkdir(parents=True)
        shutil.copytree(wheels, home / "wheels")
        shutil.copytree(_PROJECT / "systemd", home / "systemd")
        for name in ("install.sh", "README.md", "SAFETY.md", "LICENSE"):
            shutil.copy(_PROJECT / name, home / name)
        documents = root / "usr/share/doc" / _NAME
        documents.mkdir(parents=True)
        (documents / "copyright").write_text(_copyright(home / "wheels"))
        control = root / "DEBIAN"
        control.mkdir(mode=0o755)
        size = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
        (control / "control").write_text(
            _CONTROL.format(
                name=_NAME,
                version=about["version"],
                architecture=architecture,
                maintainer=about["authors"][0]["name"],
                installed_kb=size // 1024,
                python=python,
                next_python=f"{major}.{int(minor) + 1}",
                description=about["description"].partition(":")[0],
            )
        )
        for name, text in (("postinst", _POSTINST), ("prerm", _PRERM), ("postrm", _POSTRM)):
            (control / name).write_text(text)
            (control / name).chmod(0o755)
        subprocess.run(["/bin/chmod", "-R", "u=rwX,go=rX", str(root)], check=True)
        package = output / f"{_NAME}_{about['version']}_{architecture}.deb"
        # Wheels are compressed already: to do so again takes minutes and saves nothing.
        run(
            ["dpkg-deb", "--root-owner-group", "-Znone", "--build", str(root), str(package)],
            log=log,
            what="the package",
        )
    return package


def _copyright(wheels: Path) -> str:
    """Return the list of what is carried, under which licence, and where its source is, by the wheels' own words."""
    lines = [
        f"{_NAME} is under the licence in /{_HOME}/LICENSE.",
        "",
        f"Carried as published, in /{_HOME}/wheels, licences inside:",
    ]
    for wheel in sorted(wheels.glob("*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            (name,) = [
                n for n in archive.namelist() if n.count("/") == 1 and n.endswith(".dist-info/METADATA")
            ]
            metadata = email.parser.Parser().parsestr(archive.read(name).decode())
        named = [c for c in metadata.get_all("Classifier", []) if c.startswith("License ::")]
        classified = ", ".join(entry.rpartition(":: ")[2] for entry in named)
        licence = (
            metadata["License-Expression"] or classified or (metadata["License"] or "").partition("\n")[0]
        )
        addresses = [
            metadata["Home-page"],
            *[u.partition(", ")[2] for u in metadata.get_all("Project-URL", [])],
        ]
        source = next((address for address in addresses if address), "")
        lines.append(
            f"  {metadata['Name']} {metadata['Version']}: {licence or 'see the wheel'}  {source}".rstrip()
        )
    return "\n".join(lines) + "\n"
