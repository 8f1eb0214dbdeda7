"""A recording of our own recorder (MCAP), picture by picture, with the poses that were recorded."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from companion.errors import SourceError
from companion.guidance.observation import Pose
from companion.io.messages import Kind
from companion.recorder import topics
from companion.recorder.reading import RecordingError, RecordingFile
from companion.sim.recorded_poses import RecordedPoses

_DAMAGE: Final = (McapError, ValueError, struct.error, EOFError, zstandard.ZstdError)
_POSE_REACH_NS: Final = 500_000_000
"""Further from the first and last pose than this, none is known."""


class McapClip:
    """One MCAP file. Pictures are found by its index; a file that was cut off has none and is read from its beginning."""

    camera_file = ""

    def __init__(self, path: Path) -> None:
        self._path = path
        exposed_ns: list[int] = []
        poses: dict[int, tuple[float, ...]] = {}
        try:
            for message in RecordingFile(path).messages(images=False):
                if message.kind is Kind.FRAME:
                    exposed_ns.append(message.time_ns)
                elif message.kind is Kind.POSE:
                    poses[message.time_ns] = _pose_numbers(message.fields)
                elif message.kind is Kind.DETECTION and (pose := message.fields.get("pose")) is not None:
                    # The detector was given this one for its frame: it stands in where poses were not recorded.
                    numbers = (pose["north_m"], pose["east_m"], pose["down_m"], *pose["q_ned_from_body"])
                    poses.setdefault(int(pose["time_ns"]), tuple(float(number) for number in numbers))
        except (RecordingError, KeyError, TypeError, ValueError) as error:
            raise SourceError(f"{path.name}: {error}") from error
        if not exposed_ns:
            raise SourceError(f"{path.name}: there are no pictures in this recording")
        self._has_index = self._has_summary()
        self._logged_ns = [log_time for log_time, _ in self._images()]
        count = min(len(self._logged_ns), len(exposed_ns))
        self._exposed_ns = exposed_ns[:count]
        self.times_ns = [time_ns - exposed_ns[0] for time_ns in self._exposed_ns]
        self._poses, self._poses_from_ns, self._poses_to_ns = _poses_of(poses)
        self.has_poses = self._poses is not None

    def picture(self, number: int) -> NDArray[np.uint8] | None:
        """Return a picture, (H, W) uint8; None where it cannot be decoded."""
        logged_ns = self._logged_ns[number]
        # Pictures may have been recorded at one time: of these, the one at its place.
        same = number - self._logged_ns.index(logged_ns)
        for place, (_, data) in enumerate(self._images(logged_ns)):
            if place == same:
                try:
                    encoded, _ = topics.picture_of(data)
                    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
                except (ValueError, cv2.error):
                    return None
                return None if image is None else np.asarray(image, np.uint8)
        return None

    def pose(self, number: int) -> Pose | None:
        """Return the vehicle's pose at a picture's time, where it is known."""
        time_ns = self._exposed_ns[number]
        if self._poses is None or not (
            self._poses_from_ns - _POSE_REACH_NS <= time_ns <= self._poses_to_ns + _POSE_REACH_NS
        ):
            return None
        (north_m, east_m, down_m), attitude = self._poses.pose_at((time_ns - self._poses_from_ns) / 1e9)
        return Pose(self.times_ns[number], north_m, east_m, down_m, attitude)

    def close(self) -> None:
        """Nothing is held."""

    def _has_summary(self) -> bool:
        try:
            with self._path.open("rb") as file:
                return make_reader(file).get_summary() is not None
        except (*_DAMAGE, OSError):
            return False

    def _images(self, at_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield log times and data of all pictures, or of those logged at one time."""
        try:
            with self._path.open("rb") as file:
                if self._has_index:
                    reader = make_reader(file)
                    for _, _, message in reader.iter_messages(
                        [topics.IMAGE], starting_at=at_ns, ending_at=at_ns
                    ):
                        yield message.log_time, message.data
                    return
                channels: set[int] = set()
                for record in StreamReader(file).records:
                    if isinstance(record, Channel) and record.topic == topics.IMAGE:
                        channels.add(record.id)
                    elif (
                        isinstance(record, Message)
                        and record.channel_id in channels
                        and at_ns in (None, record.log_time)
                    ):
                        yield record.log_time, record.data
        except (*_DAMAGE, OSError):
            return  # cut off or damaged: what came before it can be shown


def _pose_numbers(fields: Mapping[str, Any]) -> tuple[float, ...]:
    """Return north, east and down (m), and the attitude (w, x, y, z), of a recorded pose."""
    position, orientation = fields["pose"]["position"], fields["pose"]["orientation"]
    return (*(float(position[axis]) for axis in "xyz"), *(float(orientation[axis]) for axis in "wxyz"))


def _poses_of(found: Mapping[int, tuple[float, ...]]) -> tuple[RecordedPoses | None, int, int]:
    """Return the trajectory, and from when to when it was recorded (ns); None where there are fewer than two good poses."""
    if len(found) < 2:
        return None, 0, 0
    times_ns = sorted(found)
    table = np.array([found[time_ns] for time_ns in times_ns], np.float64)
    times_s = np.array([(time_ns - times_ns[0]) / 1e9 for time_ns in times_ns])
    try:
        poses = RecordedPoses(times_s, table[:, :3].copy(), table[:, 3:].copy())
    except ValueError:
        return None, 0, 0
    return poses, times_ns[0], times_ns[-1]
