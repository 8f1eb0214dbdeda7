"""How long the detector takes, beside what it is measured against: all in one run, in turns, on the same frames.

Measured on every pair of a stream, each with frames that are as a camera gives them (nothing known about them yet):

``literal``
    The transcription of the paper in ``tests/reference/paper.py``, where that is at hand (a checkout): its first loop.
``literal_other``
    The same with p, n and k of its first loop kept.
``first``
    Our first loop on a fresh detector: both frames prepared, p, n and k estimated.
``other``
    Our other loops, as in a stream: one frame prepared (the earlier one was, when it was the later frame of the pair before), p, n and k kept;
    from the frame to its answer. What follows the answer, renewing the locations for the next pair, is timed on its own (``renewal``).
``floor``
    The Lucas-Kanade calls alone, there and back, on the very points that ``other`` started from, with its window, levels and iterations, on plain arrays.
``parallax``
    The method ``parallax`` in a stream, without poses: one frame prepared, one pair answered, rotation and direction of travel from the flow. With an attitude it takes less.
``parallax_poses``
    The same with the poses, where the frames have them: where a pose says which way the camera went, the first look is at a smaller picture.
``flow_balance``, ``line_vp``
    Rivals for scale (:mod:`detector.evaluation.methods`), from two plain frames to the answer, or to knowing that there is none. The third, the middle of the image, takes no time that
    could be measured.
``sfm``
    Two-view structure from motion (:mod:`detector.two_view`), which the paper compares its time with.

The order of the turns changes from pair to pair, so that caches and other load on the machine favour none of them.

Time is elapsed time, or processor time of all threads where the machine has other work to do (:data:`CLOCKS`): then a busy machine costs caches, not waiting.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Final

import cv2
import numpy as np
import sklearn
from threadpoolctl import threadpool_limits

from detector.bench_frames import Stream
from detector.bench_memory import peak_memory
from detector.bench_paths import SERIES, Clock, Paths, Samples
from detector.params import DetectorParams

CLOCKS: Final[Mapping[str, Clock]] = MappingProxyType({"wall": time.perf_counter, "cpu": time.process_time})
"""Seconds by name: as on the wall, or those that the processors spent on this process."""
OVER_FLOOR: Final = ("other", "parallax", "parallax_poses", "flow_balance", "line_vp")
"""What is given as a multiple of the Lucas-Kanade calls alone (``floor``)."""
_LITERAL_FILE: Final = Path(__file__).parents[1] / "tests" / "reference" / "paper.py"
_POINT_CAPS: Final = (150, 300, 500, 800, 1200)
"""Of the curve over the number of points."""


def literal_reference() -> ModuleType | None:
    """Return the literal transcription of the paper; None outside a checkout, where there is none."""
    if not _LITERAL_FILE.is_file():
        return None
    name = "detector_literal_reference"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, _LITERAL_FILE)
    if spec is None or spec.loader is None:
        return None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # its dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def run(
    streams: dict[tuple[int, int], Stream],
    params: DetectorParams,
    *,
    repeats: int = 3,
    threads: Sequence[int] = (1, 2),
    literal: ModuleType | None = None,
    clock: str = "wall",
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Measure and return the figures as plain values (the keys of ``detector bench --json``, docs/performance.md).

    Parameters
    ----------
    streams
        By width and height, frames of that size; three at least, since an other loop needs a pair before it.
    params
        Of our own path. The literal one has the same settings as far as it has words for them, and as many k-means runs as the exact path.
    repeats
        Passes over each stream.
    threads
        Numbers of threads; ``sizes`` holds the figures for the first of them, ``more_threads`` those for the others.
    literal
        What :func:`literal_reference` gives.
    clock
        Which of :data:`CLOCKS`.
    progress
        Called with a word on what comes next.

    Raises
    ------
    ValueError
        A stream is shorter than three frames, its frames are not of their size, or there is nothing to repeat.
    """
    if repeats < 1 or not threads or min(threads) < 1:
        raise ValueError(f"expected repeats and threads of at least 1, got {repeats}, {list(threads)}")
    for (width, height), stream in streams.items():
        if len(stream) < 3 or any(image.shape != (height, width) for image in stream):
            raise ValueError(
                f"expected at least 3 frames of {width}x{height}, got {[i.shape for i in stream]}"
            )
    before = _load_average()
    by_threads: dict[int, dict[str, Any]] = {count: {} for count in threads}
    points: list[dict[str, Any]] = []
    for size, stream in streams.items():
        name = f"{size[0]}x{size[1]}"
        memory = peak_memory(stream, params)
        for count in threads:
            if progress is not None:
                progress(f"{name}, {count} thread{'s' if count > 1 else ''}")
            with limited_threads(count):
                samples = measure(stream, params, repeats, literal, clock=CLOCKS[clock])
            by_threads[count][name] = _summary(samples, memory)
        if not points:  # one size says it
            if progress is not None:
                progress(f"{name}, number of points")
            with limited_threads(threads[0]):
                points = measure_points(stream, params, CLOCKS[clock])
    return {
        "sizes": by_threads[threads[0]],
        "threads": threads[0],
        "more_threads": {str(count): by_threads[count] for count in threads[1:]},
        "points": points,
        "literal_n_init": None if literal is None else params.kmeans_restarts,
        "speed": params.speed,
        "repeats": repeats,
        "clock": clock,
        "load_average": {"before": before, "after": _load_average()},
        "machine": machine(),
    }


def measure(
    stream: Stream,
    params: DetectorParams,
    repeats: int,
    literal: ModuleType | None = None,
    series: Sequence[str] = SERIES,
    clock: Clock = time.perf_counter,
) -> Samples:
    """Time series on the pairs of a stream, in turns; the first pass over it is not counted.

    Parameters
    ----------
    stream
        At least three frames.
    params, repeats, literal
        See :func:`run`.
    series
        Which of :data:`SERIES`.
    clock
        Gives seconds.
    """
    paths = Paths(stream, params, literal, series, clock)
    for pair in range(1, len(stream) - 1):  # what is slow once only: imports, caches, memory that grows
        paths.warm_up(pair)
    samples = Samples()
    for _ in range(repeats):
        paths.begin()
        for pair in range(1, len(stream) - 1):
            shift = (pair + len(samples.seconds[series[0]])) % len(series)
            for name in (*series[shift:], *series[:shift]):
                paths.sample(name, pair, samples)
    return samples


def measure_points(
    stream: Stream, params: DetectorParams, clock: Clock = time.perf_counter
) -> list[dict[str, Any]]:
    """Return the time of the other loops and of the floor against the number of points, which the fast path's cap is varied for.

    Returns
    -------
    An entry for each answered pair: ``size``, ``n`` points that the flow started from, ``other_s``, ``floor_s``. The exact path has no
    cap: its pairs come as they are.
    """
    height, width = stream[0].shape
    caps = _POINT_CAPS if params.speed == "fast" else (params.fast_points,)
    found = []
    for cap in caps:
        most = params.model_copy(
            update={"fast_points": cap, "fast_first_points": max(cap, params.fast_first_points)}
        )
        found += _per_pair(
            f"{width}x{height}", measure(stream, most, 1, series=("other", "floor"), clock=clock)
        )
    return found


@contextlib.contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Let OpenCV, BLAS and OpenMP use so many threads."""
    opencv = cv2.getNumThreads()
    with threadpool_limits(count):
        cv2.setNumThreads(count)
        try:
            yield
        finally:
            cv2.setNumThreads(opencv)


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.system(),
        "architecture": platform.machine(),
        "python": platform.python_version(),
        "opencv": cv2.__version__,
        "numpy": np.__version__,
        "scikit_learn": sklearn.__version__,
    }


# ---------------------------------------------------------------------- summing up


def _summary(samples: Samples, memory: dict[str, float | None]) -> dict[str, Any]:
    seconds, counted = samples.seconds, len(samples.seconds["other"])
    return {
        **{f"{name}_s": _spread(seconds[name]) for name in SERIES},
        "renewal_s": _spread(samples.renewal_s),
        "literal_over_first": _ratio(seconds["literal"], seconds["first"]),
        "literal_over_other": _ratio(seconds["literal_other"], seconds["other"]),
        **{f"{name}_over_floor": _ratio(seconds[name], seconds["floor"]) for name in OVER_FLOOR},
        "sfm_over_first": _ratio(seconds["sfm"], seconds["first"]),
        "sfm_over_other": _ratio(seconds["sfm"], seconds["other"]),
        **memory,
        "steps": {name: _step_spread(steps) for name, steps in samples.steps.items()},
        "samples": counted,
        "without_answer": {name: sum(s is None for s in seconds[name]) for name in SERIES},
        "answers": samples.kinds,
        "points": {name: _median(counts) for name, counts in samples.points.items()},
    }


def _per_pair(size: str, samples: Samples) -> list[dict[str, Any]]:
    """Return the time against the number of points, one entry an answered other loop."""
    answered = [
        (other, floor)
        for other, floor in zip(samples.seconds["other"], samples.seconds["floor"], strict=True)
        if other is not None
    ]
    return [
        {"size": size, "n": n, "other_s": other, "floor_s": floor}
        for n, (other, floor) in zip(samples.points["other"], answered, strict=True)
    ]


def _spread(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": float(np.median(known)), "p95": float(np.percentile(known, 95))}


def _ratio(above: Sequence[float | None], below: Sequence[float | None]) -> float | None:
    """Return the median over the samples of the ratio within a sample, so that load on the machine meets both sides."""
    both = [a / b for a, b in zip(above, below, strict=True) if a is not None and b is not None]
    return float(np.median(both)) if both else None


def _step_spread(steps: Sequence[dict[str, float]]) -> dict[str, dict[str, float] | None]:
    names = dict.fromkeys(name for each in steps for name in each)
    return {name: _spread([each.get(name, 0.0) for each in steps]) for name in names}


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _load_average() -> float | None:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    if path.is_file():
        fields = dict(
            [part.strip() for part in line.split(":", 1)]
            for line in path.read_text(encoding="utf-8", errors="replace").splitlines()
            if ":" in line
        )
        for key in ("model name", "Model", "Hardware"):  # the second is a Raspberry Pi's
            if fields.get(key):
                return fields[key]
    return platform.processor() or platform.machine()
