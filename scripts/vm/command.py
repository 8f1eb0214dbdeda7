"""The command line of ``scripts/vm-test``."""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from vm.errors import VmError
from vm.machine import run_machine
from vm.root_image import provide_image
from vm.tools import require_host, require_tools
from vm.wheels import provide_wheels

_PROJECT: Final = Path(__file__).resolve().parents[2]
_GUEST: Final = Path(__file__).resolve().parent / "guest"
_GROUPS: Final = ("cameras", "flight", "service")
_DESCRIPTION = """\
Boot a stock Debian 12 kernel in QEMU with the kernel's test camera (vivid), install the built wheel there, and check it
on a real V4L2 driver and under a real systemd. Needs root the first time, for debootstrap. What is checked, and how to
read the output: docs/vm-test.md."""


def main() -> int:
    """Run it and return the exit code: 0 all passed, 1 something failed, 2 the machine could not be tried."""
    arguments = _parser().parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that QEMU ends with it
    try:
        results = _try(arguments)
    except VmError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    _print_table(results)
    done = any(result["check"] == "finished" for result in results)
    if not done:
        print("error: the guest switched itself off before its checks were done", file=sys.stderr)
        return 2
    return 1 if any(result["outcome"] == "FAIL" for result in results) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="scripts/vm-test", description=_DESCRIPTION)
    parser.add_argument(
        "groups", nargs="*", metavar="GROUP", help=f"what to check: {', '.join(_GROUPS)} (default: all)"
    )
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path("/var/tmp/void-companion-vm"),  # noqa: S108  a cache that outlives a reboot; the name is documented
        help="folder for the guest's disk, the wheels and the logs, about 2 GB (default: %(default)s)",
    )
    parser.add_argument("--mirror", metavar="URL", help="Debian mirror (default: the one that apt uses here)")
    parser.add_argument(
        "--accel", choices=("tcg", "kvm"), default="tcg", help="tcg: in software, anywhere (default)"
    )
    parser.add_argument("--cpus", type=int, default=2, help="processors of the guest (default: %(default)s)")
    parser.add_argument(
        "--memory", type=int, default=2048, metavar="MB", help="memory of the guest (default: %(default)s)"
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=3600,
        metavar="S",
        help="give up after this time (default: %(default)s)",
    )
    parser.add_argument(
        "--capture", type=float, default=60, metavar="S", help="length of the capture (default: %(default)s)"
    )
    return parser


def _try(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    groups = arguments.groups or list(_GROUPS)
    if unknown := [group for group in groups if group not in _GROUPS]:
        raise VmError(f"unknown group {unknown[0]!r}; known: {', '.join(_GROUPS)}")
    require_host()
    cache: Path = arguments.cache.resolve()
    cache.mkdir(parents=True, exist_ok=True)
    log = cache / "host.log"
    log.write_text("")
    require_tools(["qemu-system-x86_64"], log=log)
    _say("the wheel and its dependencies")
    wheels, project_wheel = provide_wheels(_PROJECT, cache, log=log)
    _say("the guest's disk (minutes, when it is not kept from before)")
    image = provide_image(cache, wheels, project_wheel=project_wheel, mirror=arguments.mirror)
    for old in cache.glob("run-*"):
        shutil.rmtree(old)
    folder = Path(tempfile.mkdtemp(prefix="run-", dir=cache))
    results = folder / "results"
    results.mkdir()
    checks = folder / "checks"
    shutil.copytree(_GUEST, checks, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(_PROJECT / "systemd", checks / "install" / "systemd")
    for name in ("install.sh", "README.md", "SAFETY.md", "LICENSE"):
        shutil.copy(_PROJECT / name, checks / "install")
    (checks / "plan.json").write_text(json.dumps({"groups": groups, "capture_s": arguments.capture}))
    _say(f"the guest; its console: {folder / 'console.log'}")
    follower = _Follower(results / "results.jsonl")
    run_machine(
        image,
        shares={"checks": (checks, False), "wheels": (wheels, False), "results": (results, True)},
        folder=folder,
        processors=arguments.cpus,
        memory_mb=arguments.memory,
        accelerator=arguments.accel,
        limit_s=arguments.limit,
        poll=follower.poll,
    )
    return follower.results


class _Follower:
    """Reads what the guest writes, line by line, and shows it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read_bytes = 0
        self.results: list[dict[str, Any]] = []

    def poll(self) -> None:
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._read_bytes)
            new = file.read()
        whole = new[: new.rfind(b"\n") + 1]  # the guest may be in the middle of a line
        self._read_bytes += len(whole)
        for line in whole.splitlines():
            result = json.loads(line)
            self.results.append(result)
            print(f"  {result['outcome']}  {result['check']}: {result['detail']}", flush=True)


def _print_table(results: list[dict[str, Any]]) -> None:
    width = max((len(result["check"]) for result in results), default=0)
    print()
    for result in results:
        print(
            f"{result['outcome']:4}  {result['check']:{width}}  {result['seconds']:6.1f} s  {result['detail']}"
        )
    counts = {outcome: sum(r["outcome"] == outcome for r in results) for outcome in ("PASS", "FAIL", "SKIP")}
    print("\n" + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()))


def _say(text: str) -> None:
    print(f"vm-test: {text}", flush=True)
