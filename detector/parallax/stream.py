"""The parallax method on a stream of frames: pairs by distance flown, the map's memory, the answer with its confidence.

VoidObserver (which two frames) -> ParallaxDetector (one pair) -> MapMemory (what the last pairs say together) -> answer
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.flow import Tracks
from detector.frame import Frame
from detector.observer import CameraPose, Observation, ObserverParams, VoidObserver
from detector.parallax.confidence import confidence
from detector.parallax.decision import GAP, decide_on
from detector.parallax.map_memory import MapMemory, MapMemoryParams, RememberedMap
from detector.parallax.params import ParallaxParams
from detector.parallax.pipeline import Intrinsics, PairGeometry, ParallaxDetector, ParallaxResult
from detector.parallax.ranges import contact_about
from detector.parallax.samples import RangedSamples
from detector.parallax.seen_space import SeenSpace
from detector.parallax.sure_map import SureMap
from detector.parallax.uncalibrated import UncalibratedCamera
from detector.parallax.void_map import Gap, VoidMap, VoidMapParams, choose_gap
from detector.params import DetectorParams
from detector.pipeline import PairResult
from detector.results import Detection, Direction, DirectionKind, NoDetection, NoDetectionReason

_CONTACT_GATE_RAD: Final = math.radians(5.0)
_SAYS_NOTHING: Final = (NoDetectionReason.NO_MOTION, NoDetectionReason.NO_EARLIER_FRAME)
"""Without parallax there is nothing to see; what was seen before stays so."""
_ELEVATIONS_RAD: Final = np.radians(sorted(range(-45, 46), key=abs))


@dataclass(frozen=True, slots=True)
class MapReading:
    """What was measured and remembered at one frame that made a pair in metres.

    Attributes
    ----------
    samples
        Of this pair, in the level frame.
    measured
        The map of this pair alone.
    remembered
        What the last pairs say together, from this place.
    surely
        What may be flown: with what was seen near before, and short in a plain scene (:mod:`detector.parallax.sure_map`).
    gap
        The answer from it; None where it is another.
    confidence
        Of the answer, in [0, 1]; None where there is none.
    """

    samples: RangedSamples
    measured: VoidMap
    remembered: RememberedMap
    surely: VoidMap
    gap: Gap | None
    confidence: float | None


@dataclass(frozen=True, slots=True)
class ParallaxObservation(Observation):
    """An observation with its map.

    Attributes
    ----------
    reading
        None where the frame made no pair in metres.
    swept_m
        How far the vehicle's disc can be moved from here through what was looked through (:class:`detector.parallax.seen_space.SeenSpace`); None without a pose.
    """

    reading: MapReading | None = None
    swept_m: NDArray[np.float64] | None = None


class ParallaxObserver:
    """Takes frame after frame, as :class:`detector.observer.VoidObserver` does, and answers from the void map.

    Parameters
    ----------
    params, map_params, memory_params
        Settings.
    camera, camera_source
        Model of the camera, and where it came from: ``calibration`` or ``field_of_view``. Without it the focal length is estimated from the flow of several pairs
        (:mod:`detector.parallax.focal`); until that is sure enough a field of view is assumed, and the answer says which (``intrinsics_source``).
    observer_params
        How pairs are chosen.
    timer
        Gives seconds, for the time of each step.
    """

    def __init__(
        self,
        params: ParallaxParams | None = None,
        map_params: VoidMapParams | None = None,
        memory_params: MapMemoryParams | None = None,
        *,
        camera: CameraModel | None = None,
        camera_source: str = "field_of_view",
        observer_params: ObserverParams | None = None,
        timer: Callable[[], float] = time.perf_counter,
    ) -> None:
        frame_params = DetectorParams.preset("default")
        self._map_params = map_params or VoidMapParams()
        self._params = params or ParallaxParams()
        self._memory = MapMemory(memory_params)
        self._sure_map = SureMap(self._map_params, memory_params)
        self._seen_space = SeenSpace(self._map_params)
        self._pairs = _Pairs(
            ParallaxDetector(self._params, self._map_params, frame_params=frame_params, timer=timer),
            camera_source,
            UncalibratedCamera(self._params),
        )
        self._observer = VoidObserver(
            frame_params,
            camera,
            # Its own flow on a grid is not needed beside this one's.
            observer_params=replace(observer_params or ObserverParams(), dense=None),
            detector=self._pairs,
        )
        self._last_ns: int | None = None

    def reset(self) -> None:
        """Forget all frames and maps."""
        self._observer.reset()
        self._memory.forget()
        self._sure_map.forget()
        self._seen_space.forget()
        self._last_ns = None

    def between_frames(self) -> None:
        """Nothing is left to do between frames."""

    def observe(
        self, image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None = None
    ) -> ParallaxObservation:
        """Take the next frame and answer on it; as :meth:`detector.observer.VoidObserver.observe`."""
        if self._last_ns is not None and time_ns <= self._last_ns:
            self.reset()
        self._last_ns = time_ns
        self._pairs.next(pose)
        seen = self._observer.observe(image, time_ns, pose)
        detection, reading = seen.detection, None
        result = self._pairs.result
        if result is not None and pose is not None:
            detection, reading = self._remembered(result, pose, time_ns)
        swept_m = None if pose is None else self._swept_m(seen.detection, reading, pose, time_ns)
        return ParallaxObservation(
            detection,
            seen.time_ns,
            seen.earlier_time_ns,
            seen.baseline_m,
            seen.focus_px if result is None else result.focus_px,
            None,
            reading,
            swept_m,
        )

    def _swept_m(
        self, detection: Detection, reading: MapReading | None, pose: CameraPose, time_ns: int
    ) -> NDArray[np.float64]:
        """Take what was looked through, and return how far the vehicle can be moved through it."""
        position_m, time_s = (float(pose.position_m[0]), float(pose.position_m[1])), time_ns / 1e9
        seen_space = self._seen_space
        seen_space.been(position_m, time_s)
        if reading is not None:
            seen_space.look(reading.samples, position_m, time_s)
        elif not (isinstance(detection, NoDetection) and detection.reason in _SAYS_NOTHING):
            seen_space.missed()
        return seen_space.reach_m(position_m, time_s)

    def _remembered(
        self, result: ParallaxResult, pose: CameraPose, time_ns: int
    ) -> tuple[Detection, MapReading | None]:
        geometry, decision = result.geometry, result.decision
        if geometry is None or decision is None or not (geometry.samples.metric and geometry.is_level):
            return result.detection, None
        position_m = (float(pose.position_m[0]), float(pose.position_m[1]))
        measured, memory = decision.void_map, self._memory
        memory.add(measured, position_m, time_ns / 1e9)
        remembered = memory.remembered(position_m, time_ns / 1e9)
        surely = self._sure_map.add(measured, geometry.samples, remembered.found, position_m, time_ns / 1e9)
        # The answer is a place in this picture; what is remembered beside it is for the way, not for the answer.
        in_view = remembered.found.where(measured.known)
        diagnostics = result.detection.diagnostics
        decided = decide_on(geometry, in_view, 1.0, self._params, self._map_params)
        if decided.kind != GAP:
            found = choose_gap(in_view, self._map_params)
            sure = None if found is None else confidence(remembered, found)
            detection = replace(decided, confidence=sure).answer(diagnostics)
            sure = None if isinstance(detection, NoDetection) else sure
            return detection, MapReading(geometry.samples, measured, remembered, surely, None, sure)
        gap = memory.answer(in_view, self._map_params)
        point = None if gap is None else _seen_at(geometry, gap.azimuth_rad)
        if gap is None or point is None:
            return decided.answer(diagnostics), MapReading(
                geometry.samples, measured, remembered, surely, None, None
            )
        ray, (x_px, y_px) = point
        sure = confidence(remembered, gap)
        contact = contact_about(geometry.depths, geometry.motion, ray, _CONTACT_GATE_RAD)
        detection = Direction(x_px, y_px, DirectionKind.GAP, contact, diagnostics, sure)
        return detection, MapReading(geometry.samples, measured, remembered, surely, gap, sure)


class _Pairs:
    """The parallax method as :class:`detector.observer.PairDetector`, keeping the last result for what the observer does not hand on."""

    def __init__(
        self, detector: ParallaxDetector, camera_source: str, uncalibrated: UncalibratedCamera
    ) -> None:
        self._detector = detector
        self._camera_source = camera_source
        self._uncalibrated = uncalibrated
        self._pose: CameraPose | None = None
        self.result: ParallaxResult | None = None

    def next(self, pose: CameraPose | None) -> None:
        """Take the pose of the frame that comes next."""
        self._pose, self.result = pose, None

    def reset(self) -> None:
        """Nothing is kept from pair to pair."""
        self._detector.reset()

    def detect(
        self,
        earlier: Frame,
        later: Frame,
        *,
        camera: CameraModel | None = None,
        later_from_earlier: NDArray[np.float64] | None = None,
        translation_earlier: NDArray[np.float64] | None = None,
    ) -> PairResult:
        """Return the answer to one pair."""
        height_px, width_px = later.image.shape
        intrinsics = (
            self._uncalibrated.intrinsics(width_px, height_px)
            if camera is None
            else Intrinsics(camera, self._camera_source)
        )
        self.result = self._detector.detect(
            earlier,
            later,
            intrinsics=intrinsics,
            later_from_earlier=later_from_earlier,
            translation_earlier_m=translation_earlier,
            level_from_later=None if self._pose is None else self._pose.world_from_camera,
        )
        if camera is None and self.result.geometry is not None and self.result.field is not None:
            self._uncalibrated.learn(self.result.field)
        return PairResult(self.result.detection, Tracks.none(), self.result.focus_px)


def _seen_at(
    geometry: PairGeometry, azimuth_rad: float
) -> tuple[NDArray[np.float64], tuple[float, float]] | None:
    """Return the ray (in the later camera) and pixel of an azimuth: level where the picture holds that, else as near to level as it does."""
    level = np.cos(_ELEVATIONS_RAD)
    rays = np.column_stack(
        [level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), -np.sin(_ELEVATIONS_RAD)]
    )
    rays = rays @ geometry.frame_from_later
    camera = geometry.camera
    x_px, y_px = camera.ray_to_pixel(rays).T
    inside = np.flatnonzero(
        (x_px >= 0) & (x_px <= camera.width_px - 1) & (y_px >= 0) & (y_px <= camera.height_px - 1)
    )
    if inside.size == 0:
        return None
    return rays[inside[0]], (float(x_px[inside[0]]), float(y_px[inside[0]]))
