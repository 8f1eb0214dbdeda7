"""``companion sim suite``: real flights in their processes, reports, a second start, Ctrl-C, and words for mistakes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import pytest

from companion.cli import main
from companion.sim.flight_record import FlightRecord

BOX = """
name = "box"
start = { north_m = 2, east_m = 2 }
goal = { north_m = 4, east_m = 2 }
walls = [
    { from_m = [0, 0], to_m = [8, 0] },
    { from_m = [8, 0], to_m = [8, 4] },
    { from_m = [8, 4], to_m = [0, 4] },
    { from_m = [0, 4], to_m = [0, 0] },
    { from_m = [WALL, 0], to_m = [WALL, 4] },
]
"""
OPEN = BOX.replace("WALL", "6")
BLOCKED = BOX.replace("WALL", "3")


def suite(folder: Path, *words: str) -> list[str]:
    (folder / "open.toml").write_text(OPEN)
    (folder / "blocked.toml").write_text(BLOCKED)
    worlds = [str(folder / "open.toml"), str(folder / "blocked.toml")]
    return ["sim", "suite", "--worlds", *worlds, "--methods", "off", "-o", str(folder / "out"), *words]


@pytest.mark.slow
def test_flights_are_flown_reported_and_not_flown_again(tmp_path, capsys):
    words = suite(tmp_path, "--seeds", "5", "-j", "2", "--json")
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    assert [(flight["name"], flight["outcome"], flight["succeeded"]) for flight in first["flights"]] == [
        ("open-s5-off", "reached", True),
        ("blocked-s5-off", "collided", False),
    ]
    out = tmp_path / "out"
    assert "| open.toml | off | 1 | 1 | 0 | 0 | 0 | 0 | 1 |" in (out / "suite.md").read_text()
    assert json.loads((out / "suite.json").read_text()) == first
    assert cv2.imread(str(out / "sheet.png")).any()
    reached, collided = first["flights"]
    assert reached["video"] is None
    video = cv2.VideoCapture(str(out / collided["video"]))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == pytest.approx(10 * collided["result"]["time_s"], abs=2)
    video.release()
    record = FlightRecord.load(out / reached["record"])
    assert record.about["result"]["path_m"] == reached["result"]["path_m"]

    flown = {path: path.stat().st_mtime_ns for path in (out / "flights").iterdir()}
    assert main(words[:-1]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "flights").iterdir()} == flown
    assert "blocked.toml" in capsys.readouterr().out


def processes_with(text: str) -> set[int]:
    """Processes with that text among their words."""
    found = set()
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdigit() and text.encode() in (entry / "cmdline").read_bytes():
                found.add(int(entry.name))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_suite_leaves_nothing_behind_and_says_how_to_go_on(tmp_path, number):
    places = tmp_path / "temporary"
    places.mkdir()
    # What runs in a shell's background inherits an ignored SIGINT; a user's terminal does not do that.
    words = ["env", "--default-signal=INT", sys.executable, "-m", "companion"]
    words += suite(tmp_path, "--seeds", "1..9", "-j", "2")
    process = subprocess.Popen(
        words, env={**os.environ, "TMPDIR": str(places)}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    pause = threading.Event()
    while not processes_with(f"{places}/flight-"):  # the test's time limit ends this
        assert process.poll() is None
        pause.wait(0.05)
    process.send_signal(number)
    try:
        output, _ = process.communicate(timeout=90)
    finally:
        process.kill()
    assert process.returncode == 130
    assert b"of 18 flights are flown; the same command flies the others" in b" ".join(output.split())
    assert processes_with(str(places)) == set()
    assert not list(places.glob("flight-*"))
    assert not (tmp_path / "out" / "suite.md").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--worlds", "nowhere"], "world: found \"nowhere\""),
        (["--worlds", "random", "--difficulty", "absurd"], "difficulty: found 'absurd'"),
        (["--worlds", "room", "-j", "0"], "--jobs: found 0"),
        (["--worlds", "room", "--rate", "1000"], "frame_rate_hz: found 1000"),
        (["--worlds", "room", "room"], "asked for twice"),
        (["--worlds", "room,corridor,room"], "asked for twice"),
    ],
)  # fmt: skip
def test_a_suite_that_cannot_be_flown_is_one_clear_line(tmp_path, capsys, words, said):
    assert main(["sim", "suite", *words, "-o", str(tmp_path)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "flights").exists()


def test_a_fault_of_a_world_file_is_told_before_anything_flies(tmp_path, capsys):
    file = tmp_path / "hall.toml"
    file.write_text(OPEN.replace("box", "") + "colour = 3\n")
    assert main(["sim", "suite", "--worlds", str(file), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "hall.toml: name: " in said
    assert "hall.toml: colour: unknown key" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seeds", "5..3"], "A up to B"),
        (["--seeds", "a"], "expected A..B"),
        (["--methods", "paper,magic"], "got 'magic'"),
    ],
)
def test_wrong_words_are_explained(tmp_path, capsys, words, said):
    with pytest.raises(SystemExit) as caught:
        main(["sim", "suite", "--worlds", "room", "-o", str(tmp_path), *words])
    assert caught.value.code == 2
    assert said in capsys.readouterr().err
