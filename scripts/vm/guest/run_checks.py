"""Runs in the guest, as root, at every boot: makes the checks of the plan, then switches the machine off."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import camera_checks
import flight_checks
import machine_checks
import service_checks
from report import write

_PLAN = Path(__file__).parent / "plan.json"
_REBOOTED = Path("/var/lib/vm-check-rebooted")


def main() -> None:
    """Make the checks; whatever becomes of them, switch the machine off, or boot it again where a check asks for it."""
    groups = json.loads(_PLAN.read_text())["groups"]
    next_step = "poweroff"
    try:
        if _REBOOTED.exists():
            service_checks.after_reboot()
            write("finished", "PASS", ", ".join(groups), 0.0)
        elif _first_boot(groups):
            service_checks.prepare_reboot()
            _REBOOTED.touch()
            next_step = "reboot"
        else:
            write("finished", "PASS", ", ".join(groups), 0.0)
    finally:
        subprocess.run(["/usr/bin/systemctl", next_step], check=False)


def _first_boot(groups: list[str]) -> bool:
    """Make the checks of the first boot; return whether there is something to look at after another one."""
    capture_s = json.loads(_PLAN.read_text())["capture_s"]
    if not machine_checks.prepare():
        return False
    if "cameras" in groups:
        camera_checks.run_all(capture_s)
    if "flight" in groups:
        flight_checks.run_all()
    return "service" in groups and service_checks.before_reboot()


if __name__ == "__main__":
    main()
