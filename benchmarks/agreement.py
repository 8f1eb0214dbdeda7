"""How often the fast path gives the literal method's answer, against how often that gives its own with other k-means starts.

    python benchmarks/agreement.py [DIR...] [--preset paper|default] [--seeds N] [--limit N] [--json FILE]

k-means begins at random places, and the method's answer depends on them: two literal runs that differ in nothing but the seed
often disagree. That is the measure for a fast path: it should differ from the literal one no more often than that differs from itself.

Preset paper: the fast path against the literal transcription (tests/reference), both with the paper preset as far as the
transcription can express it (no blur limit). Preset default: some of it the transcription has no word for, so the exact path stands in for it.

Every pair is a first loop on its own, and nothing is told of the camera or its motion. Sets: each DIR (a groundtruth.json, or a walk's poses.json,
paired at 0.25 m), once more with its frames turned back where it has such; tests/data/pairs; and rendered scenes.

Two answers are the same when their kind is (vanishing_point, lowest_flow, single_plane, none) and, for directions, they lie
within a twentieth of the width. Intervals: 95 %, paired bootstrap over the pairs. Neighbouring pairs of a walk are alike, so the true ones are wider.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import statistics
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

# This folder holds a detector.py too, and Python looks here first.
if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[1])

from companion.guidance.coordinates import r_body_from_camera
from companion.sim.scene import corridor, empty_room, room_with_wall, square_wall
from detector.bench import limited_threads, literal_reference
from detector.camera_model import CameraModel
from detector.commands import inputs
from detector.evaluation.bootstrap import known_mean, resampled
from detector.evaluation.dataset import load_truth, pairs_by_baseline
from detector.evaluation.methods import NONE, SINGLE_PLANE, Answer, PaperMethod
from detector.evaluation.run import Settings, evaluate
from detector.params import DetectorParams

NEAR_SHARE = 0.05
WALK_BASELINE_M = 0.25
REPOSITORY_PAIRS = Path(__file__).parents[1] / "tests" / "data" / "pairs"


class Literal:
    """The transcription as a method that can be judged."""

    def __init__(self, params, seed):
        module = literal_reference()
        assert module is not None, "tests/reference is part of a checkout"
        self._void_of_pair, self._settings = module.void_of_pair, module.settings_of(params)
        self._starts = module.random_starts(seed, params.kmeans_restarts)

    def answer(self, pair):
        found = self._void_of_pair(pair.earlier, pair.later, self._starts, self._settings)
        if found.kind in ("vanishing_point", "lowest_flow"):
            return Answer(found.kind, (found.x_px, found.y_px))
        return Answer(SINGLE_PLANE) if found.kind == "single_plane" else Answer(NONE, reason=found.kind)

    def vanishing_point(self, image):
        return None

    def reset(self):
        pass


# ---------------------------------------------------------------------- sets


def write_scenes(folder: Path) -> None:
    """Render corridors (the way is the vanishing point), rooms, and walls met squarely (single planes)."""
    camera, looking_north = CameraModel.from_hfov(640, 480, 80.0), r_body_from_camera(0.0, 0.0, 0.0)
    frames, pairs = {}, []

    def add(name, scene, down_m, truth, starts_m, step_m=0.25):
        for number, north_m in enumerate(starts_m):
            files = []
            for which, at_m in (("a", north_m), ("b", north_m + step_m)):
                file = f"{name}_{number}{which}.png"
                image = scene.render(camera, (at_m, 0.0, down_m), looking_north)
                noise = np.random.default_rng(len(frames)).normal(0, 1.5, image.shape)
                cv2.imwrite(str(folder / file), np.clip(image + noise, 0, 255).astype(np.uint8))
                depth_m = scene.depth(camera, (at_m, 0.0, down_m), looking_north)
                frames[file] = {**truth, "depth": {"column_profile_m": profile(depth_m)}}
                files.append(file)
            pairs.append({"a": files[0], "b": files[1]})

    middle = {"vp": [319.5, 239.5], "single_plane": False}
    for seed in (4, 8, 15):
        add(f"corridor{seed}", corridor(seed=seed), -1.3, middle, (0.0, 1.0, 2.0))
        narrow = corridor(width_m=1.8, seed=seed)
        add(f"narrow{seed}", narrow, -1.3, middle, (0.0, 1.0, 2.0))
        add(f"room{seed}", empty_room(seed=seed), -1.3, {"single_plane": False}, (0.0, 0.5))
        walled = room_with_wall(wall_north_m=3.0, seed=seed)
        add(f"walled{seed}", walled, -1.3, {}, (0.0, 0.5))
        for distance_m in (2.5, 4.0, 5.0):
            wall = square_wall(distance_m=distance_m, seed=seed)
            add(f"wall{seed}_{distance_m:.0f}", wall, 0.0, {"single_plane": True}, (0.0,))
    truth = {"name": "rendered scenes", "image_size": [640, 480], "K": None, "frames": frames, "pairs": pairs}
    (folder / "groundtruth.json").write_text(json.dumps(truth))


def profile(depth_m: np.ndarray) -> list[float]:
    rows = depth_m[int(0.2 * len(depth_m)) : int(0.7 * len(depth_m))]
    return [float(np.percentile(part, 20)) for part in np.array_split(rows, 18, axis=1)]


def write_repository_pairs(folder: Path) -> None:
    for kind, size in (("office", [540, 360]), ("brickwall", [256, 256])):
        target = folder / kind
        shutil.copytree(REPOSITORY_PAIRS / kind, target)
        files = sorted(path.name for path in target.glob("*.jpg"))
        truth = {"single_plane": True} if kind == "brickwall" else {}
        table = {
            "name": f"tests/data/pairs/{kind}",
            "image_size": size,
            "frames": dict.fromkeys(files, truth),
            "pairs": [{"a": a, "b": b} for a, b in zip(files[::2], files[1::2], strict=True)],
        }
        (target / "groundtruth.json").write_text(json.dumps(table))


def jobs_of(folders: Sequence[Path], limit: int):
    """Yield each set with its pairs, and whether its later frames are the ones turned back."""
    for folder in folders:
        path = folder / "groundtruth.json"
        is_walk = not path.is_file()
        images = load_truth(folder / "poses.json" if is_walk else path)
        pairs = pairs_by_baseline(images, WALK_BASELINE_M) if is_walk else images.pairs
        if len(pairs) > limit:
            pairs = tuple(pairs[i] for i in np.linspace(0, len(pairs) - 1, limit).round().astype(int))
        if pairs:
            yield images, pairs, False
        if pairs and all(pair.b_derot is not None for pair in pairs):
            yield images, pairs, True


# ---------------------------------------------------------------------- comparing


def same_answer(first, second) -> bool:
    if first.kind != second.kind:
        return False
    return not first.is_direction or distance(first, second) <= NEAR_SHARE


def distance(first, second) -> float:
    return math.dist((first.x_px, first.y_px), (second.x_px, second.y_px)) / first.width_px


def agreement(first: Sequence, second: Sequence) -> dict[str, np.ndarray]:
    """Compare two runs pair by pair; NaN where a figure is not defined for a pair."""
    both = list(zip(first, second, strict=True))
    directions = [
        distance(a, b) <= NEAR_SHARE if a.is_direction and b.is_direction else math.nan for a, b in both
    ]
    return {
        "kind": np.array([a.kind == b.kind for a, b in both], float),
        "answer": np.array([same_answer(a, b) for a, b in both], float),
        "direction": np.array(directions, float),
    }


def mean_of(runs: Sequence[dict[str, np.ndarray]], key: str) -> np.ndarray:
    """Average comparisons pair by pair; NaN where none of them is defined."""
    values = np.array([run[key] for run in runs])
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0).sum(axis=0), known.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), math.nan)


def verdict_of(verdict) -> str:
    """Say whether an answer is right, wrong, silent, or not known to be either."""
    if verdict.kind == NONE:
        return "right" if verdict.no_motion_truth else "silent"
    if verdict.no_motion_truth:
        return "wrong"
    plane = verdict.single_plane_truth
    if verdict.kind == SINGLE_PLANE:
        if plane is None:
            return "unknown"
        return "right" if plane else "wrong"
    if plane:
        return "wrong"
    return "unknown" if verdict.right is None else ("right" if verdict.right else "wrong")


def summary(fast: Sequence, literal: Sequence[Sequence]) -> dict:
    """Return the figures of a run of the fast path against runs of the literal one that differ in the seed."""
    ours = [agreement(fast, run) for run in literal]
    theirs = [agreement(a, b) for i, a in enumerate(literal) for b in literal[i + 1 :]]
    result: dict = {"pairs": len(fast)}
    for key in ("kind", "answer", "direction"):
        mine, own = mean_of(ours, key), mean_of(theirs, key)
        a, b = (float(known_mean(values[None, :])[0]) for values in (mine, own))
        interval = resampled(
            len(mine), lambda drawn, x=mine, y=own: known_mean(x[drawn]) - known_mean(y[drawn])
        )
        result[key] = {"fast": a, "literal_itself": b, "difference": a - b, "interval": interval}
        if key == "direction":
            result[key]["pairs_fast"] = int(np.isfinite(mine).sum())
            result[key]["pairs_literal"] = int(np.isfinite(own).sum())
    # Each literal run is compared, since which of them is "the" literal one is chance.
    verdicts = Counter(
        f"{verdict_of(a)}/{verdict_of(b)}"
        for run in literal
        for a, b in zip(fast, run, strict=True)
        if not same_answer(a, b)
    )
    result["disagreements_fast_slash_literal"] = dict(sorted(verdicts.items()))
    result["kinds"] = {
        "fast": dict(Counter(v.kind for v in fast)),
        "literal": dict(Counter(v.kind for run in literal for v in run)),
    }
    result["verdicts"] = {
        "fast": dict(Counter(verdict_of(v) for v in fast)),
        "literal": dict(Counter(verdict_of(v) for run in literal for v in run)),
    }
    result["seconds"] = {
        "fast": statistics.median(v.seconds for v in fast),
        "literal": statistics.median(v.seconds for run in literal for v in run),
    }
    return result


# ---------------------------------------------------------------------- running


def methods_of(preset: str, seeds: int):
    """Return the parameters, the fast method, and the makers of the slow ones by seed."""
    if preset == "paper":
        params = DetectorParams.preset("paper", blur_limit=1.0, speed="fast")
        return params, [Literal(params, seed) for seed in range(seeds)]
    params = DetectorParams.preset("default", speed="fast")
    return params, [
        PaperMethod(params.model_copy(update={"speed": "exact", "seed": seed})) for seed in range(seeds)
    ]


def run(folders: Sequence[Path], preset: str, seeds: int, limit: int) -> dict:
    params, slow = methods_of(preset, seeds)
    fast = PaperMethod(params)
    sets, all_fast, all_slow = {}, [], [[] for _ in slow]
    for images, pairs, derotated in jobs_of(folders, limit):
        settings = Settings("paper", preset, params, poses="none", derotated=derotated)
        found = [
            evaluate(images, pairs, settings, inputs.read_image, method=method).verdicts
            for method in (fast, *slow)
        ]
        name = f"{images.name}{', turned back' if derotated else ''}"
        sets[name] = summary(found[0], found[1:])
        all_fast += found[0]
        for every, verdicts in zip(all_slow, found[1:], strict=True):
            every.extend(verdicts)
        row = sets[name]["answer"]
        print(
            f"{name}: {len(pairs)} pairs, same answer {row['fast']:.2f}, literal itself {row['literal_itself']:.2f}",
            file=sys.stderr,
            flush=True,
        )
    return {
        "preset": preset,
        "reference": "literal" if preset == "paper" else "exact",
        "seeds": seeds,
        "n_init": params.kmeans_restarts,
        "all": summary(all_fast, all_slow),
        "sets": sets,
    }


def markdown(result: dict) -> str:
    other = result["reference"]
    lines = [
        f"Preset {result['preset']}: fast against {other}, {result['seeds']} seeds, n_init {result['n_init']}.",
        "",
        f"| set | pairs | same kind: fast, {other} itself | same answer | difference | direction within W/20 |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in [*result["sets"].items(), ("**all**", result["all"])]:
        cells = [f"{row[key]['fast']:.2f}, {row[key]['literal_itself']:.2f}" for key in ("kind", "answer")]
        low, high = row["answer"]["interval"] or (math.nan, math.nan)
        of = row["direction"]
        directions = f"{of['fast']:.2f}, {of['literal_itself']:.2f} (of {of['pairs_fast']})"
        directions = directions if of["pairs_fast"] else "-"
        lines.append(
            f"| {name} | {row['pairs']} | {cells[0]} | {cells[1]} | {row['answer']['difference']:+.3f} "
            f"({low:+.3f} .. {high:+.3f}) | {directions} |"
        )
    lines += ["", f"| where they differ: fast, {other} | cases |", "|---|---|"]
    lines += [
        f"| {key.replace('/', ', ')} | {count} |"
        for key, count in result["all"]["disagreements_fast_slash_literal"].items()
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="*", metavar="DIR")
    parser.add_argument("--preset", choices=("paper", "default"), default="paper")
    parser.add_argument("--seeds", type=int, default=3, help="runs of the literal method (default: 3)")
    parser.add_argument("--limit", type=int, default=60, help="most pairs of a set, evenly (default: 60)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    arguments = parser.parse_args()
    if arguments.seeds < 2 or arguments.limit < 1:
        parser.error("--seeds needs 2 and --limit 1 at least")
    with tempfile.TemporaryDirectory(prefix="agreement-") as name:
        own = Path(name)
        (own / "scenes").mkdir()
        write_scenes(own / "scenes")
        write_repository_pairs(own)
        folders = [*arguments.folders, own / "office", own / "brickwall", own / "scenes"]
        with limited_threads(1):
            result = run(folders, arguments.preset, arguments.seeds, arguments.limit)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(inputs.json_clean(result), indent=1) + "\n")
    print(markdown(result))


if __name__ == "__main__":
    main()
