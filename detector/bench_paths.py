"""What the benchmark times: each series on one pair of a stream, and what came of it. :mod:`detector.bench` says what the series are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from detector import flow, two_view
from detector.bench_frames import Stream
from detector.camera_model import CameraModel
from detector.evaluation.methods import METHODS, PairInput
from detector.parallax.pipeline import Intrinsics, ParallaxDetector
from detector.params import DetectorParams
from detector.pipeline import VoidDetector
from detector.results import Detection, Direction, SinglePlane

Clock = Callable[[], float]
RIVALS: Final = ("flow_balance", "line_vp")
"""Of :data:`detector.evaluation.methods.METHODS`; the middle of the image (``straight``) takes no time that could be measured."""
SERIES: Final = (
    "literal",
    "literal_other",
    "first",
    "other",
    "floor",
    "parallax",
    "parallax_poses",
    *RIVALS,
    "sfm",
)
_STEPPED: Final = ("first", "other", "parallax", "parallax_poses", "sfm")
_ASSUMED_HFOV_DEG: Final = 80.0
"""For what needs a camera and is told none; the time hardly depends on which."""
_FEWEST_POINTS: Final = 10


@dataclass(slots=True)
class Samples:
    """Seconds of one size: a list for each of :data:`SERIES`, entry by entry of the same pair and repeat; None where there was no answer."""

    seconds: dict[str, list[float | None]] = field(default_factory=lambda: {name: [] for name in SERIES})
    steps: dict[str, list[dict[str, float]]] = field(default_factory=lambda: {name: [] for name in _STEPPED})
    points: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in ("first", "other")})
    renewal_s: list[float] = field(default_factory=list)
    kinds: dict[str, dict[str, int]] = field(default_factory=lambda: {name: {} for name in SERIES})

    def note(self, series: str, seconds: float | None, kind: str) -> None:
        """Add one sample and the kind of its answer."""
        self.seconds[series].append(seconds)
        self.kinds[series][kind] = self.kinds[series].get(kind, 0) + 1

    def note_detection(self, series: str, detection: Detection, seconds: float, prepared_s: float) -> bool:
        """Add one sample of a detector and its steps, of which preparing the frames took ``prepared_s``; return whether it answered."""
        answered = isinstance(detection, Direction | SinglePlane)
        self.note(series, seconds if answered else None, _kind_of(detection))
        if answered:
            steps = dict(detection.diagnostics.seconds)
            steps["frames"] = steps.get("frames", 0.0) + prepared_s
            self.steps[series].append(steps)
        return answered


class Paths:
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
        # The literal path is warmed up below; "other" finds the points of "floor", which needs no more.
        warmed = ("other", "first", "parallax", "parallax_poses", *RIVALS, "sfm")
        self._warmed = [name for name in warmed if name in series]
        self._rivals = {name: METHODS[name](params) for name in RIVALS}
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
        self._parallax_earlier = {
            name: self._parallax.prepare(self._stream[1]) for name in ("parallax", "parallax_poses")
        }

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
            self._parallax_loop(series, pair, samples, Intrinsics(self._camera, "assumed"))
        elif series == "parallax_poses":
            self._parallax_with_poses(pair, samples)
        elif series in RIVALS:
            begin = self._clock()
            said = self._rivals[series].answer(PairInput(earlier, later, self._camera))
            # Without an answer it took the same: it has looked for one all the way.
            samples.note(series, self._clock() - begin, said.reason or said.kind)
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
        if samples.note_detection(series, detection, end - begin, prepared - begin):
            samples.points[series].append(0 if earlier.seeds_px is None else len(earlier.seeds_px))

    def _parallax_loop(
        self,
        series: str,
        pair: int,
        samples: Samples,
        intrinsics: Intrinsics,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier_m: NDArray[np.float64] | None = None,
        level_from_later: NDArray[np.float64] | None = None,
    ) -> None:
        begin = self._clock()
        later = self._parallax.prepare(self._stream[pair + 1])
        prepared = self._clock()
        detection = self._parallax.detect(
            self._parallax_earlier[series],
            later,
            intrinsics=intrinsics,
            later_from_earlier=later_from_earlier,
            translation_earlier_m=translation_earlier_m,
            level_from_later=level_from_later,
        ).detection
        end = self._clock()
        self._parallax_earlier[series] = later
        samples.note_detection(series, detection, end - begin, prepared - begin)

    def _parallax_with_poses(self, pair: int, samples: Samples) -> None:
        camera = self._stream.camera
        if camera is None or not self._stream.poses:
            samples.note("parallax_poses", None, "not_run")
            return
        earlier, later = self._stream.poses[pair], self._stream.poses[pair + 1]
        self._parallax_loop(
            "parallax_poses",
            pair,
            samples,
            Intrinsics(camera, "calibration"),
            *earlier.motion_to(later),
            later.world_from_camera,
        )

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


def _kind_of(detection: Detection) -> str:
    if isinstance(detection, Direction):
        return detection.kind.value
    return "single_plane" if isinstance(detection, SinglePlane) else detection.reason.value
