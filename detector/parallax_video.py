"""A clip answered by the parallax method: the answer on each frame, with the void map over the image and from above."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.camera_model import CameraModel
from detector.drawing.frame import FrameCanvas
from detector.drawing.void_map import draw_map_from_above, draw_map_over
from detector.flow import Tracks
from detector.observer import CameraPose
from detector.overlay import headline, legible_zoom
from detector.parallax.stream import ParallaxObservation, ParallaxObserver
from detector.video import Answered, FrameAnswerer

_INSET_SHARE = 0.42


def by_parallax(camera: CameraModel | None) -> FrameAnswerer:
    """Return what answers with the void map and its memory; metres, and so the map, need poses.

    Parameters
    ----------
    camera
        Its model; without one a field of view is assumed.
    """
    observer = ParallaxObserver(camera=camera)

    def answer(image: NDArray[np.uint8], time_ns: int, pose: CameraPose | None) -> Answered:
        seen = observer.observe(image, time_ns, pose)
        paint = None
        if camera is not None and pose is not None and seen.reading is not None:

            def paint(picture: NDArray[np.uint8], notes: tuple[str, ...]) -> NDArray[np.uint8]:
                return draw_reading(picture, seen, camera, pose.world_from_camera, notes=notes)

        return Answered.of(seen, Tracks.none(), paint)

    return answer


def draw_reading(
    image: NDArray[np.uint8],
    seen: ParallaxObservation,
    camera: CameraModel,
    level_from_camera: NDArray[np.float64],
    *,
    notes: tuple[str, ...] = (),
) -> NDArray[np.uint8]:
    """Return a frame with its map on the horizon, the map from above in a corner, and the answer in words.

    Parameters
    ----------
    image
        (H, W) uint8.
    seen
        The observation of this frame, with a reading.
    camera, level_from_camera
        As :func:`detector.drawing.void_map.draw_map_over` takes them.
    notes
        Lines of ASCII text below those about the answer.

    Raises
    ------
    ValueError
        When the observation has no reading.
    """
    reading = seen.reading
    if reading is None:
        raise ValueError("expected an observation with a map, got one without")
    zoom = legible_zoom(image.shape[1])
    canvas = FrameCanvas(image)
    found = reading.remembered.found
    canvas.picture = draw_map_over(
        image, found, camera, level_from_camera, samples=reading.samples, gap=reading.gap, zoom=zoom
    )
    canvas.unit = max(1, round(canvas.picture.shape[1] / 640))
    canvas.band([headline(seen.detection), *notes], at_the_bottom=False)
    axis = level_from_camera[:, 2]
    inset = draw_map_from_above(
        found,
        heading_rad=math.atan2(float(axis[1]), float(axis[0])),
        gap=reading.gap,
        confidence=reading.confidence,
    )
    side = round(_INSET_SHARE * canvas.picture.shape[0])
    canvas.picture[-side:, -side:] = cv2.resize(inset, (side, side), interpolation=cv2.INTER_AREA)
    return canvas.picture
