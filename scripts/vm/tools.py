"""The programs of the host that the virtual machine needs, and where its packages come from."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Final

from vm.errors import VmError, run

_PACKAGES: Final = {
    "qemu-system-x86_64": "qemu-system-x86",
    "debootstrap": "debootstrap",
    "mke2fs": "e2fsprogs",
}
NICE: Final = ["nice", "-n", "10"]


def require_host() -> None:
    """Refuse hosts on which the guest's system cannot be made.

    Raises
    ------
    VmError
        When this is not Linux on x86-64.
    """
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise VmError(
            f"the guest is made by debootstrap for x86-64 Linux; this is {platform.system()} {platform.machine()}"
        )


def require_tools(names: list[str], *, log: Path) -> None:
    """Make sure that these programs are there; install their Debian packages where that is possible.

    Raises
    ------
    VmError
        When one is missing and cannot be installed.
    """
    # /usr/sbin is not in everybody's PATH, and is where debootstrap and mke2fs live.
    os.environ["PATH"] = os.environ.get("PATH", "/usr/bin:/bin") + ":/usr/sbin:/sbin"
    packages = [_PACKAGES[name] for name in names if shutil.which(name) is None]
    if not packages:
        return
    command = ["apt-get", "install", "--no-install-recommends", "-y", *packages]
    advice = f"{', '.join(packages)} needed. Run: sudo {' '.join(command)}"
    if shutil.which("apt-get") is None:
        raise VmError(
            f"{', '.join(packages)} needed, and there is no apt-get here: install them by other means"
        )
    as_root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    if as_root and shutil.which("sudo") is None:
        raise VmError(advice)
    try:
        run([*as_root, "apt-get", "-q", "update"], log=log, what="the package lists")
        run([*as_root, "env", "DEBIAN_FRONTEND=noninteractive", *command], log=log, what="the packages")
    except VmError as error:
        raise VmError(f"{advice} ({error})") from error
    if missing := [name for name in names if shutil.which(name) is None]:
        raise VmError(f"{', '.join(packages)} installed, yet {', '.join(missing)} cannot be found")


def debian_mirror(suite: str) -> str:
    """Return the mirror that this machine's apt takes a Debian release from.

    Raises
    ------
    VmError
        When apt knows none.
    """
    words = [
        "apt-get",
        "indextargets",
        "--format",
        "$(REPO_URI) $(CODENAME) $(ORIGIN) $(COMPONENT)",
        "Created-By: Packages",
    ]
    try:
        listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise VmError("apt does not say which Debian mirror it uses: give one with --mirror URL") from error
    for line in listed.splitlines():
        uri, codename, *rest = line.split()
        if codename == suite and rest == ["Debian", "main"]:
            return uri
    raise VmError(f"apt here has no Debian {suite} (run apt-get update, or give a mirror with --mirror URL)")
