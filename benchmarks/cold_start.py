"""How long `companion run` takes from its start to READY=1, on the footage of the demo.

Usage: python benchmarks/cold_start.py [RUNS]
"""

from __future__ import annotations

import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from companion.sim.companion_process import toml_of
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA

LIMIT_S = 60.0


def start_s(folder: Path) -> float:
    config = folder / "companion.toml"
    config.write_text(
        toml_of(
            {
                "source": {"url": f"file:{OFFICE_WALK}", "loop": True},
                "camera": {"file": str(OFFICE_WALK_CAMERA)},
                "link": {"planner": "udpin:127.0.0.1:0", "autopilot": "udpin:127.0.0.1:0"},
            }
        )
    )
    address = folder / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(LIMIT_S)
        words = [sys.executable, "-m", "companion", "run", "-c", str(config)]
        begin_s = time.monotonic()
        process = subprocess.Popen(
            words, env={**os.environ, "NOTIFY_SOCKET": str(address)}, stderr=subprocess.DEVNULL
        )
        try:
            while manager.recv(4096) != b"READY=1":
                pass
            return time.monotonic() - begin_s
        finally:
            process.terminate()
            process.wait()


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    times_s = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            times_s.append(start_s(Path(folder)))
    load = os.getloadavg()[0]
    print(
        f"start to READY=1, {runs} runs: median {statistics.median(times_s):.2f} s, slowest {max(times_s):.2f} s "
        f"(load {load:.1f} on {os.cpu_count()} processors)"
    )


if __name__ == "__main__":
    main()
