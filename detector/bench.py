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
``sfm``
    Two-view structure from motion (:mod:`detector.two_view`), which the paper compares its time with.

The order of the seven turns from pair to pair, so that caches and other load on the machine favour none of them.

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
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Final

import cv2
import numpy as np
import sklearn
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from detector import flow, two_view
from detector.bench_frames import Stream
from detector.bench_memory import peak_memory
from detector.camera_model import CameraModel
from detector.parallax.pipeline import Intrinsics, ParallaxDetector
from detector.params import DetectorParams
from detector.pipeline import VoidDetector
from detector.results import Detection, Direction, SinglePlane

Clock = Callable[[], float]
CLOCKS: Final[Mapping[str, Clock]] = MappingProxyType({"wall": time.perf_counter, "cpu": time.process_time})
"""Seconds by name: as on the wall, or those that the processors spent on this process."""
SERIES: Final = ("literal", "literal_other", "first", "other", "floor", "parallax", "sfm")
_LITERAL_FILE: Final = Path(__file__).parents[1] / "tests" / "reference" / "paper.py"
_ASSUMED_HFOV_DEG: Final = 80.0
"""For structure from motion, which needs a camera; its time hardly depends on which."""
_FEWEST_POINTS: Final = 10
_POINT_CAPS: Final = (150, 300, 500, 800, 1200)
"""Of the curve over the number of points."""


@dataclass(slots=True)
class Samples:
    """Seconds of one size: a list for each of :data:`SERIES`, entry by entry of the same pair and repeat; None where there was no answer."""

    seconds: dict[str, list[float | None]] = field(default_factory=lambda: {name: [] for name in SERIES})
    steps: dict[str, list[dict[str, float]]] = field(
        default_factory=lambda: {name: [] for name in ("first", "other", "parallax", "sfm")}
    )
    points: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in ("first", "other")})
    renewal_s: list[float] = field(default_factory=list)
    kinds: dict[str, dict[str, int]] = field(default_factory=lambda: {name: {} for name in SERIES})

    def note(self, series: str, seconds: float | None, kind: str) -> None:
        """Add one sample and the kind of its answer."""
        self.seconds[series].append(seconds)
        self.kinds[series][kind] = self.kinds[series].get(kind, 0) + 1


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
    paths = _Paths(stream, params, literal, series, clock)
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


class _Paths:
    """The series on one stream. Pair i is (frame i, frame i + 1)."""

    def __init__(
        self,
        stream: Stream,
        params: DetectorParams,
        literal: ModuleType | None,
        series: Sequence[str],
        clock: Clock,
    ) -> None:
        self._clock = clock
        self._stream, self._params, self._literal = stream, params, literal
        self._warmed = [
            name for name in ("other", "first", "parallax", "sfm") if name in series
        ]  # literal is, below
        height, width = stream[0].shape
        self._camera = CameraModel.from_hfov(width, height, _ASSUMED_HFOV_DEG)
        self._kept: Any = None
        if literal is not None:
            self._settings = literal.settings_of(params)
            self._starts = literal.random_starts(params.seed, params.kmeans_restarts)
            for pair in range(len(stream) - 1):  # the first that leads to clusters
                answer = self._literal_answer(pair, None)
                if answer.k is not None:
                    self._kept = literal.Kept(answer.p, answer.n, answer.k)
                    break
        self._points: dict[int, NDArray[np.float32]] = {}
        self.begin()

    def begin(self) -> None:
        """Start the stream anew: the first pair is our first loop and is not counted."""
        self._detector = VoidDetector(self._params, timer=self._clock)
        self._earlier = self._detector.prepare(self._stream[0])
        later = self._detector.prepare(self._stream[1])
        self._detector.detect(self._earlier, later)
        self._detector.renew(later)
        self._earlier = later
        self._parallax = ParallaxDetector(frame_params=self._params, timer=self._clock)
        self._parallax_earlier = self._parallax.prepare(self._stream[1])

    def warm_up(self, pair: int) -> None:
        """Run once what is measured later; this also finds the points that the other loops start from."""
        samples = Samples()
        for series in self._warmed:
            self.sample(series, pair, samples)

    def sample(self, series: str, pair: int, samples: Samples) -> None:
        """Run one series on one pair and note its time."""
        earlier, later = self._stream[pair], self._stream[pair + 1]
        if series in ("literal", "literal_other"):
            kept = self._kept if series == "literal_other" else None
            if self._literal is None or (series == "literal_other" and kept is None):
                samples.note(series, None, "not_run")
                return
            begin = self._clock()
            answer = self._literal_answer(pair, kept)
            seconds = self._clock() - begin
            answered = answer.kind in ("vanishing_point", "lowest_flow", "single_plane")
            samples.note(series, seconds if answered else None, answer.kind)
        elif series in ("first", "other"):
            self._our_loop(series, pair, samples)
        elif series == "parallax":
            self._parallax_loop(pair, samples)
        elif series == "floor":
            points = self._points.get(pair)
            if points is None or len(points) < _FEWEST_POINTS:
                samples.note(series, None, "no_points")
                return
            begin = self._clock()
            lucas_kanade_alone(earlier, later, points, self._params)
            samples.note(series, self._clock() - begin, "tracked")
        else:
            begin = self._clock()
            found = two_view.reconstruct(earlier, later, self._camera, timer=self._clock)
            seconds = self._clock() - begin
            samples.note(series, seconds if found.failure is None else None, found.failure or "reconstructed")
            if found.failure is None:
                samples.steps["sfm"].append(dict(found.seconds))

    def _our_loop(self, series: str, pair: int, samples: Samples) -> None:
        image_a, image_b = self._stream[pair], self._stream[pair + 1]
        begin = self._clock()
        if series == "first":
            detector = VoidDetector(self._params, timer=self._clock)
            earlier = detector.prepare(image_a)
        else:
            detector, earlier = self._detector, self._earlier
        later = detector.prepare(image_b)
        prepared = self._clock()
        detection = detector.detect(earlier, later).detection
        end = self._clock()
        if series == "other":
            begin_renewal = self._clock()
            detector.renew(later)
            samples.renewal_s.append(self._clock() - begin_renewal)
            self._earlier = later
            if earlier.seeds_px is not None:
                self._points[pair] = earlier.seeds_px
        answered = isinstance(detection, Direction | SinglePlane)
        samples.note(series, end - begin if answered else None, _kind_of(detection))
        if answered:
            steps = dict(detection.diagnostics.seconds)
            steps["frames"] = steps.get("frames", 0.0) + prepared - begin
            samples.steps[series].append(steps)
            samples.points[series].append(0 if earlier.seeds_px is None else len(earlier.seeds_px))

    def _parallax_loop(self, pair: int, samples: Samples) -> None:
        begin = self._clock()
        later = self._parallax.prepare(self._stream[pair + 1])
        prepared = self._clock()
        intrinsics = Intrinsics(self._camera, "assumed")
        detection = self._parallax.detect(self._parallax_earlier, later, intrinsics=intrinsics).detection
        end = self._clock()
        self._parallax_earlier = later
        answered = isinstance(detection, Direction | SinglePlane)
        samples.note("parallax", end - begin if answered else None, _kind_of(detection))
        if answered:
            steps = dict(detection.diagnostics.seconds)
            steps["frames"] = steps.get("frames", 0.0) + prepared - begin
            samples.steps["parallax"].append(steps)

    def _literal_answer(self, pair: int, kept: Any) -> Any:
        literal = self._literal
        assert literal is not None  # noqa: S101 - callers have looked
        return literal.void_of_pair(
            self._stream[pair], self._stream[pair + 1], self._starts, self._settings, kept
        )


def lucas_kanade_alone(
    earlier: NDArray[np.uint8],
    later: NDArray[np.uint8],
    points_px: NDArray[np.float32],
    params: DetectorParams,
) -> None:
    """Track points there and back with the detector's settings and do nothing with the outcome: the floor of any such method."""
    at = points_px
    for a, b in ((earlier, later), (later, earlier)):
        at, _ = flow.track(
            a,
            b,
            at,
            window_px=params.lk_window_px,
            levels=params.lk_levels,
            iterations=params.lk_iterations,
            epsilon_px=params.lk_epsilon_px,
        )


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
        "other_over_floor": _ratio(seconds["other"], seconds["floor"]),
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


def _kind_of(detection: Detection) -> str:
    if isinstance(detection, Direction):
        return detection.kind.value
    return "single_plane" if isinstance(detection, SinglePlane) else detection.reason.value


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
