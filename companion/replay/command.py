"""``companion replay``: a recording through the present code, and what it decides otherwise."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Final

from companion.config import Config
from companion.config_sources import ConfigPlaces, load
from companion.errors import CompanionError
from companion.io.messages import Kind
from companion.recorder.reading import RecordingFile
from companion.replay.run import DetectionsFrom, Difference, Summary, replay

_SHOWN: Final = 50


def replay_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion replay``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(
        prog="companion replay",
        description="Runs what a recording was given (frames, poses, setpoints, telemetry) through the present code at the "
        "recorded times and compares what is decided, to the last bit. Exit code 0: the same; 1: not; 2: cannot be replayed.",
    )
    parser.add_argument("file", metavar="FILE.mcap")
    parser.add_argument("-c", "--config", metavar="NEW.toml", help="settings in place of the recorded ones")
    parser.add_argument(
        "--detections",
        choices=("auto", "recorded", "rerun"),
        default="auto",
        help="recorded: the decisions given the detector's answers in flight; rerun: its answers now on the recorded frames, "
        "compared too; auto: rerun where all frames are recorded as PNG",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.0,
        metavar="X",
        help="numbers of setpoints may differ by so much (m, m/s, rad), for a recording of another processor; default 0",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    try:
        summary, found = _replayed(arguments)
    except CompanionError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    if arguments.json:
        rows = [
            {"time_s": round(d.time_s, 6), "kind": d.kind, "recorded": d.recorded, "now": d.now}
            for d in found
        ]
        sys.stdout.write(json.dumps({**summary.as_dict(), "shown": rows}, indent=2) + "\n")
    else:
        _print(summary, found)
    return 0 if summary.is_same else 1


def _replayed(arguments: argparse.Namespace) -> tuple[Summary, list[Difference]]:
    path = Path(arguments.file)
    config: Config | None = None
    if arguments.config:
        config = load(ConfigPlaces(Path(arguments.config), dict(os.environ))).config
    mode: DetectionsFrom = arguments.detections
    if arguments.detections == "auto":
        mode = "rerun" if is_lossless(RecordingFile(path)) else "recorded"
    found: list[Difference] = []

    def keep(difference: Difference) -> None:
        if arguments.json or len(found) < _SHOWN:
            found.append(difference)

    summary = replay(
        RecordingFile(path), config=config, detections=mode, tolerance=arguments.tolerance, on_difference=keep
    )
    if mode == "recorded":
        summary.notes.insert(0, "the detector's answers are the recorded ones")
    return summary, found


def is_lossless(file: RecordingFile) -> bool:
    """Return whether the frames of a recording's answers are in it, as the camera gave them."""
    frames: set[tuple[int, int]] = set()
    answers = missing = 0
    for message in file.messages(images=False):
        if message.kind is Kind.FRAME and message.fields.get("lossless"):
            frames.add((message.fields["seq"], message.time_ns))
        elif message.kind is Kind.DETECTION:
            answers += 1
            missing += (message.fields["frame_seq"], message.fields["frame_ns"]) not in frames
    return answers > 0 and missing == 0


def _print(summary: Summary, found: list[Difference]) -> None:
    for difference in found:
        sys.stdout.write(f"{difference}\n")
    total = summary.differences.total()
    if total > len(found):
        sys.stdout.write(f"... and {total - len(found)} more\n")
    for note in summary.notes:
        sys.stdout.write(f"note: {note}\n")
    counts = ", ".join(f"{count} {name}s" for name, count in sorted(summary.decisions.items()))
    inputs = summary.inputs.total()
    if summary.before_caught_up:
        sys.stdout.write(f"{summary.before_caught_up} differences before the replay had caught up\n")
    verdict = "the same" if summary.is_same else f"{total} differ" if total else "nothing to compare"
    sys.stdout.write(f"{summary.duration_s:.1f} s, {inputs} inputs, {counts or 'no decisions'}: {verdict}\n")
