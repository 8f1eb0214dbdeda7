"""Peak memory of a process that runs our path over a stream and nothing else.

Run as a module it is that process: the frames come from the ``.npy`` file that the command line names, the parameters as JSON on the
standard input, and the figures go to the standard output as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from detector.bench_frames import Stream
from detector.params import DetectorParams

_LIMIT_S: Final = 120.0
_KIB_PER_MB: Final = 1024.0


def peak_memory(stream: Stream, params: DetectorParams) -> dict[str, float | None]:
    """Measure in a process of its own, one thread.

    Parameters
    ----------
    stream
        Frames of one size.
    params
        Of the detector.

    Returns
    -------
    ``peak_mb``: most memory (MiB) resident at any time; ``peak_imports_mb``: the part that was there before the first frame. None
    where the system does not say.

    Raises
    ------
    RuntimeError
        The process failed.
    """
    with tempfile.TemporaryDirectory(prefix="detector-bench-") as folder:
        file = Path(folder) / "frames.npy"
        np.save(file, np.stack(stream.frames))
        child = subprocess.run(
            [sys.executable, "-m", "detector.bench_memory", str(file)],
            input=params.model_dump_json(),
            capture_output=True,
            text=True,
            timeout=_LIMIT_S,
            check=False,
        )
    if child.returncode != 0:
        raise RuntimeError(f"the process that measures memory failed: {child.stderr.strip()[-300:]}")
    figures: dict[str, float | None] = json.loads(child.stdout)
    return figures


def _peak_mb() -> float | None:
    """Return this process's peak resident memory.

    Linux gives a new program its starter's peak as ru_maxrss; VmHWM is its own.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / _KIB_PER_MB
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KIB_PER_MB**2
    return None


def _main(file: str) -> None:
    import cv2
    from threadpoolctl import threadpool_limits

    from detector.pipeline import VoidDetector

    params = DetectorParams.model_validate_json(sys.stdin.read())
    imported = _peak_mb()
    frames = np.load(file, mmap_mode="r")
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        detector = VoidDetector(params)
        earlier = detector.prepare(np.array(frames[0]))
        for image in frames[1:]:
            later = detector.prepare(np.array(image))
            detector.detect(earlier, later)
            earlier = later
    json.dump({"peak_mb": _peak_mb(), "peak_imports_mb": imported}, sys.stdout)


if __name__ == "__main__":
    _main(sys.argv[1])
