"""The worker's process: what it is started with."""

from __future__ import annotations

import os
import time
from pathlib import Path

from companion.vision.worker_process import WorkerProcess

NAMES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")
MOST_THAT_MALLOPT_TAKES = 32 * 1024 * 1024


def test_it_keeps_its_pictures_memory_and_the_service_is_left_alone(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    worker = WorkerProcess.start(1)
    try:
        end_s = time.monotonic() + 30.0
        while not (text := Path(f"/proc/{worker.pid}/environ").read_text()):  # none in the first moment
            assert time.monotonic() < end_s
            time.sleep(0.01)
    finally:
        worker.stop()
    found = dict(line.split("=", 1) for line in text.split("\0") if "=" in line)
    mapped_bytes, kept_bytes = (int(found[name]) for name in NAMES)
    assert 1920 * 1080 * 4 < mapped_bytes <= MOST_THAT_MALLOPT_TAKES
    assert kept_bytes >= mapped_bytes
    assert not set(NAMES) & set(os.environ)
