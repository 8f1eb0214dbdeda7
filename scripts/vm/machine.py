"""One run of QEMU: an emulated PC with shared folders, watched until it is off."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from vm.errors import VmError
from vm.root_image import RootImage
from vm.tools import NICE

_POLL_S: Final = 0.5
_KERNEL_ARGUMENTS: Final = "root=/dev/vda rw console=ttyS0 panic=-1 net.ifnames=0 loglevel=4 mitigations=off"


def run_machine(
    image: RootImage,
    *,
    shares: dict[str, tuple[Path, bool]],
    folder: Path,
    processors: int,
    memory_mb: int,
    accelerator: str,
    limit_s: float,
    poll: Callable[[], None],
) -> None:
    """Boot the image and wait until the guest has switched itself off. The image is not changed.

    Parameters
    ----------
    image
        What to boot.
    shares
        Folders that the guest sees by 9p: tag -> (folder, writable).
    folder
        Takes ``console.log`` and the disk's temporary changes.
    processors, memory_mb
        Size of the guest.
    accelerator
        ``tcg``: emulated in software, on any machine. ``kvm`` where the host has it.
    limit_s
        A guest that is on for longer is killed.
    poll
        Called twice a second, to show what the guest has written.

    Raises
    ------
    VmError
        When QEMU cannot start or the guest is not off in time; the message says what its console said last.
    """
    console = folder / "console.log"
    words = [*NICE, "qemu-system-x86_64", "-nodefaults", "-no-user-config", "-display", "none"]
    words += ["-machine", f"q35,accel={accelerator}", "-cpu", "max" if accelerator == "tcg" else "host"]
    words += ["-smp", str(processors), "-m", str(memory_mb), "-nic", "none"]
    words += ["-object", "rng-random,id=rng,filename=/dev/urandom", "-device", "virtio-rng-pci,rng=rng"]
    words += ["-kernel", str(image.kernel), "-initrd", str(image.initrd), "-append", _KERNEL_ARGUMENTS]
    words += ["-drive", f"file={image.disk},if=virtio,format=raw,snapshot=on"]
    words += ["-serial", f"file:{console}"]
    for tag, (shared, writable) in shares.items():
        access = "" if writable else ",readonly=on"
        words += [
            "-virtfs",
            f"local,path={shared},mount_tag={tag},security_model=none,multidevs=remap{access}",
        ]
    environment = {**os.environ, "TMPDIR": str(folder)}
    with (folder / "qemu.log").open("wb") as output:
        machine = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=environment,
            start_new_session=True,
        )
        try:
            end_s = time.monotonic() + limit_s
            while machine.poll() is None and time.monotonic() < end_s:
                time.sleep(_POLL_S)
                poll()
            code = machine.poll()
        finally:
            if machine.poll() is None:
                os.killpg(machine.pid, signal.SIGKILL)
                machine.wait()
    poll()
    if code is None:
        raise VmError(
            f"the guest was not done within {limit_s:.0f} s; its console's last line: {_last_line(console)}"
        )
    if code:
        raise VmError(f"QEMU ended with code {code}: {_last_line(folder / 'qemu.log')}")


def _last_line(path: Path) -> str:
    text = path.read_text(errors="replace") if path.exists() else ""
    return ([line.strip() for line in text.splitlines() if line.strip()] or ["it said nothing"])[-1]
