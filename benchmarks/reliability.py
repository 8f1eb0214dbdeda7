"""How often answers of the void map are right, by how sure they say they are; and the table that makes them say it right.

    companion sim pairs --n 240 --frames 5 --seed 77 -o DIR
    python benchmarks/reliability.py DIR [--fit] [--plot OUT.png]

DIR is a set of rendered sequences. They are observed frame by frame, as a vehicle does (poses with an error of 0.2 degrees an axis), so the memory is part of what is
judged. An answer is right where the vehicle could fly at least 0.9 times as far as in the best direction in view, by the truth's own profile; frames whose
truth is a wall are left out. ``--fit`` prints the calibration that these answers ask for: fit on one set, look at the plot of another.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import cv2
import numpy as np

# This folder holds a detector.py too, and Python looks here first.
if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[1])

import json

from detector.camera_model import CameraModel
from detector.drawing.reliability import draw_reliability
from detector.observer import CameraPose
from detector.parallax.confidence import fitted_table, reliability, score
from detector.parallax.stream import ParallaxObserver

ATTITUDE_SIGMA_RAD = math.radians(0.2)
FRAME_NS = 500_000_000


def answers(folder: Path):
    """Yield (frame, score, confidence, right) for each answer of a gap."""
    truth = json.loads((folder / "groundtruth.json").read_text(encoding="utf-8"))
    width, height = truth["image_size"]
    matrix = np.array(truth["K"])
    camera = CameraModel.from_hfov(width, height, math.degrees(2 * math.atan(0.5 * width / matrix[0, 0])))
    columns = np.arctan(((np.arange(18) + 0.5) * width / 18 - 0.5 - camera.cx_px) / camera.fx_px)
    rng = np.random.default_rng(0)
    observer, last, time_ns = ParallaxObserver(camera=camera), "", 0
    for name in truth["frames"]:
        frame = truth["frames"][name]
        sequence = name.rsplit("_", 1)[0]
        if sequence != last:
            observer, last, time_ns = ParallaxObserver(camera=camera), sequence, 0
        time_ns += FRAME_NS
        pose = np.array(frame["pose"])
        error = cv2.Rodrigues(rng.normal(0.0, ATTITUDE_SIGMA_RAD, 3))[0]
        image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
        seen = observer.observe(image, time_ns, CameraPose(pose[:3, :3] @ error, pose[:3, 3]))
        reading = seen.reading
        if reading is None or reading.gap is None or frame["wall_ahead"]:
            continue
        axis_rad = math.atan2(pose[1, 2], pose[0, 2])
        off = (reading.gap.azimuth_rad - axis_rad + math.pi) % math.tau - math.pi
        profile = np.array(frame["free_distance_profile_m"])
        right = float(np.interp(off, columns, profile)) >= 0.9 * profile.max()
        yield name, score(reading.remembered, reading.gap), reading.confidence, right


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--fit", action="store_true", help="print the calibration that these answers ask for")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="write the reliability diagram")
    parser.add_argument("--wrong", action="store_true", help="name the frames whose answer was wrong")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    found = [answer for folder in arguments.folders for answer in answers(folder)]
    if not found:
        parser.error("found no answer in a frame that is no wall")
    scores = np.array([answer[1] for answer in found])
    confidences = np.array([answer[2] for answer in found])
    right = np.array([answer[3] for answer in found])
    print(f"{len(found)} answers, {right.mean():.3f} right")
    sure = confidences >= 0.8
    if sure.any():
        print(f"confidence >= 0.8: {right[sure].mean():.3f} right, {sure.mean():.3f} of all")
    parts = reliability(confidences, right)
    for part in parts:
        print(f"confidence {part.confidence:.2f}: {part.right:.2f} right of {part.answers}")
    if arguments.fit:
        print("calibration:", fitted_table(scores, right))
    if arguments.wrong:
        for name, _, confidence, is_right in found:
            if not is_right:
                print(f"{name}: wrong, confidence {confidence:.2f}")
    if arguments.plot is not None:
        cv2.imwrite(str(arguments.plot), draw_reliability(parts))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
