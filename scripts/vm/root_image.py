"""The guest's disk: a small Debian with its stock kernel, made once and kept."""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vm.errors import VmError, run
from vm.tools import NICE, debian_mirror, require_tools

SUITE: Final = "bookworm"
VENV: Final = "/opt/void-companion"
"""Where the guest's environment is: where install.sh has it."""
_DISK_SIZE: Final = "5G"  # sparse: it takes what is in it
_PACKAGES: Final = (
    "linux-image-amd64",  # the stock kernel has vivid, videodev, virtio_blk and 9p; the cloud kernel does not promise them
    "initramfs-tools",
    "systemd-sysv",
    "udev",
    "dbus",
    "kmod",
    "procps",
    "iproute2",
    "python3",
    "python3-venv",
    "v4l-utils",
)
_FILES: Final = {
    "etc/hostname": "vm-test\n",
    "etc/fstab": (
        "/dev/vda / ext4 defaults,noatime 0 1\n"
        "checks /mnt/checks 9p trans=virtio,version=9p2000.L,ro,msize=262144 0 0\n"
        "wheels /mnt/wheels 9p trans=virtio,version=9p2000.L,ro,msize=262144 0 0\n"
        "results /mnt/results 9p trans=virtio,version=9p2000.L,msize=262144 0 0\n"
    ),
    # vm-test is no check of the machine's power: what is late here is late because the processor is emulated.
    "etc/systemd/system.conf.d/vm-test.conf": "[Manager]\nDefaultTimeoutStartSec=600\nDefaultTimeoutStopSec=120\n",
    "etc/systemd/journald.conf.d/vm-test.conf": "[Journal]\nStorage=persistent\nRateLimitIntervalSec=0\n",
    "etc/systemd/system/vm-check.service": """\
[Unit]
Description=Checks of void-companion in this virtual machine
RequiresMountsFor=/mnt/checks /mnt/wheels /mnt/results
FailureAction=poweroff

[Service]
Type=oneshot
ExecStart=/usr/bin/python3 -B /mnt/checks/run_checks.py
StandardOutput=journal+console
StandardError=journal+console
TimeoutStartSec=infinity

[Install]
WantedBy=default.target
""",
}
_LINKS: Final = {
    "etc/systemd/system/default.target.wants/vm-check.service": "/etc/systemd/system/vm-check.service",
    # Nothing here logs in, and the timers of a server would only take the emulated processor's time.
    "etc/systemd/system/default.target": "/lib/systemd/system/multi-user.target",
    "etc/systemd/system/timers.target": "/dev/null",
}
_FOLDERS: Final = ("mnt/checks", "mnt/wheels", "mnt/results", "var/log/journal")


@dataclass(frozen=True)
class RootImage:
    """What QEMU boots.

    Attributes
    ----------
    disk
        Raw ext4 file system; used as a snapshot, never written.
    kernel, initrd
        Taken out of it, so that no boot loader is needed.
    """

    disk: Path
    kernel: Path
    initrd: Path


def provide_image(cache: Path, wheels: Path, *, project_wheel: str, mirror: str | None) -> RootImage:
    """Return the guest's disk from the cache, made there first when it is missing or out of date.

    The dependencies are installed in it here, at the host's speed: an emulated processor takes minutes for them. The
    project's own wheel is not: installing that is one of the checks.

    Parameters
    ----------
    cache
        Folder of what is kept.
    wheels
        Folder with the project's wheel and everything it needs.
    project_wheel
        The name of the former.
    mirror
        Debian mirror; None for the one that apt uses here.

    Raises
    ------
    VmError
        When it cannot be made: no root, no debootstrap, no mirror.
    """
    dependencies = sorted(path.name for path in wheels.glob("*.whl") if path.name != project_wheel)
    folder = cache / f"disk-{_digest(_system_recipe(), _FILES, _LINKS, _FOLDERS, dependencies)}"
    image = RootImage(folder / "disk.img", folder / "vmlinuz", folder / "initrd.img")
    if folder.is_dir():
        return image
    if os.geteuid() != 0:
        raise VmError(
            "the guest's disk is made by debootstrap and chroot, which need root, once: run it with sudo"
        )
    log = cache / "disk.log"
    log.write_text("")
    require_tools(["debootstrap", "mke2fs"], log=log)
    system = _provide_system(cache, mirror=mirror, log=log)
    for old in cache.glob("disk-*"):
        _remove(old)
    new = cache / "disk-new"
    root = new / "root"
    new.mkdir()
    run([*NICE, "cp", "-a", "--reflink=auto", str(system), str(root)], log=log, what="the guest's system")
    _adapt(root)
    _install(root, [wheels / name for name in dependencies], log=log)
    for kept, pattern in ((image.kernel, "vmlinuz-*"), (image.initrd, "initrd.img-*")):
        found = sorted((root / "boot").glob(pattern))
        if not found:
            raise VmError(f"the guest's system has no /boot/{pattern}; the log: {log}")
        shutil.copyfile(found[-1], new / kept.name)
    disk = new / image.disk.name
    words = ["mke2fs", "-q", "-t", "ext4", "-L", "vm-test", "-d", str(root), str(disk), _DISK_SIZE]
    run([*NICE, *words], log=log, what="the guest's disk")
    shutil.rmtree(root)
    new.rename(folder)
    return image


def _remove(folder: Path) -> None:
    """Remove a root folder; one that was given up half made may still have the host's /proc in it."""
    mounted = [line.split()[1] for line in Path("/proc/self/mounts").read_text().splitlines()]
    if inside := [point for point in mounted if Path(point).is_relative_to(folder)]:
        raise VmError(
            f"{folder} is left from before and has mounts in it; run: umount {' '.join(reversed(inside))}"
        )
    shutil.rmtree(folder)


def _system_recipe() -> tuple[object, ...]:
    return SUITE, _PACKAGES


def _digest(*recipe: object) -> str:
    return hashlib.sha256(repr(recipe).encode()).hexdigest()[:12]


def _provide_system(cache: Path, *, mirror: str | None, log: Path) -> Path:
    """Return the root folder of a fresh Debian with the packages, from the cache or by debootstrap."""
    system = cache / f"system-{_digest(_system_recipe())}"
    if system.is_dir():
        return system
    for old in cache.glob("system-*"):
        _remove(old)
    new = cache / "system-new"
    words = ["debootstrap", "--variant=minbase", f"--include={','.join(_PACKAGES)}", SUITE, str(new)]
    run([*NICE, *words, mirror or debian_mirror(SUITE)], log=log, what="the guest's system")
    shutil.rmtree(new / "var/cache/apt/archives", ignore_errors=True)
    new.rename(system)
    return system


def _install(root: Path, wheels: list[Path], *, log: Path) -> None:
    """Make the guest's virtual environment and put the dependencies in it."""
    carried = root / "tmp/wheels"
    carried.mkdir()
    for wheel in wheels:
        shutil.copyfile(wheel, carried / wheel.name)
    inside = [f"/tmp/wheels/{wheel.name}" for wheel in wheels]  # noqa: S108  in the guest's root, where nobody else is
    plain = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "LANG": "C.UTF-8",
    }  # the host's settings of pip are not the guest's
    python = [
        f"{VENV}/bin/python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-cache-dir",
    ]
    for words in (["python3", "-m", "venv", VENV], [*python, *inside]):
        run(
            [*NICE, "chroot", str(root), *words],
            log=log,
            what="the dependencies in the guest",
            environment=plain,
        )
    shutil.rmtree(carried)


def _adapt(root: Path) -> None:
    for name in _FOLDERS:
        (root / name).mkdir(parents=True, exist_ok=True)
    for name, text in _FILES.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for name, target in _LINKS.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(target)
