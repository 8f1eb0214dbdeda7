"""Pipelines for the worker process to run in tests: quick, and bad in every way that matters."""

import os
import signal
import sys
import time

from companion.config import CameraConfig, DetectorConfig
from companion.errors import ConfigError
from companion.guidance.observation import DetectionReport


class Echo:
    """Reports the mean grey of each frame as x_px, the sum of its corners as y_px; obeys the first pixel."""

    SLOW, CRASH, KILLED, HANG_IN_C, LEAVE, CHATTER = 201, 202, 203, 204, 205, 206

    def detect(self, frame, pose):
        order = int(frame.image[0, 0])
        if order == self.SLOW:
            time.sleep(0.3)
        elif order == self.CRASH:
            raise RuntimeError("asked to crash")
        elif order == self.KILLED:
            os.kill(os.getpid(), signal.SIGSEGV)
        elif order == self.HANG_IN_C:
            sum(range(10**15))  # never lets go of the interpreter
        elif order == self.LEAVE:
            sys.stderr.write("I am off\n")
            sys.stderr.flush()
            os._exit(3)
        elif order == self.CHATTER:
            for i in range(2000):
                sys.stderr.write(f"line {i} {'x' * 100}\n")
        corners = frame.image[[0, 0, -1, -1], [0, -1, 0, -1]]
        return DetectionReport(
            frame.seq,
            frame.time_ns,
            "lowest_flow",
            x_px=float(frame.image.mean()),
            y_px=float(corners.sum()),
            pose=pose,
        )


def echo(detector: DetectorConfig, camera: CameraConfig):
    return Echo()


class Counts(Echo):
    """Reports how often it had time between two frames as x_px."""

    def __init__(self):
        self._times = 0

    def detect(self, frame, pose):
        return DetectionReport(
            frame.seq, frame.time_ns, "lowest_flow", x_px=float(self._times), y_px=0.0, pose=pose
        )

    def between_frames(self):
        self._times += 1


def counts(detector: DetectorConfig, camera: CameraConfig):
    return Counts()


def unusable(detector: DetectorConfig, camera: CameraConfig):
    raise ConfigError(f"{camera.file}: no such file")


def broken(detector: DetectorConfig, camera: CameraConfig):
    raise ZeroDivisionError("a fault of the program")


def never_ready(detector: DetectorConfig, camera: CameraConfig):
    time.sleep(600)


class Strange:
    """Answers with numbers that no report may have."""

    def detect(self, frame, pose):
        return DetectionReport(frame.seq, frame.time_ns, "none", detector_s=float("nan"))


def strange(detector: DetectorConfig, camera: CameraConfig):
    return Strange()


class Mistaken(Echo):
    """Answers for another frame than it was given."""

    def detect(self, frame, pose):
        return DetectionReport(frame.seq, frame.time_ns + 1, "none")


def mistaken(detector: DetectorConfig, camera: CameraConfig):
    return Mistaken()
