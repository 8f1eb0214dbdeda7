"""``detector video``: a clip in, a playable annotated clip and one JSON line a frame out, whatever ends it."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.cli import main
from detector.commands.stopping import stop_request

OFFICE = Path(__file__).parents[2] / "data" / "pairs" / "office"
KEYS = {
    "frame", "file", "method", "time_s", "earlier_time_s", "baseline_m", "kind", "x_px", "y_px", "reason", "detail",
    "time_to_contact_frames", "time_to_contact_spread_frames", "time_to_contact_samples", "time_to_contact_s",
    "time_to_contact_spread_s", "distance_m", "distance_spread_m", "confidence", "diagnostics",
}  # fmt: skip


def run(capsys, *arguments):
    code = main(["video", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def pictures_of(path):
    capture = cv2.VideoCapture(str(path))
    pictures = []
    while True:
        done, picture = capture.read()
        if not done:
            return pictures
        pictures.append(picture)


def records_of(path):
    return [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]


@pytest.fixture
def clip(tmp_path):
    """A folder whose names sort as numbers alone: 9 before 10."""
    folder = tmp_path / "clip"
    folder.mkdir()
    for name, source in (("9.jpg", "00184.jpg"), ("10.jpg", "00185.jpg"), ("11.jpg", "00194.jpg")):
        (folder / name).write_bytes((OFFICE / source).read_bytes())
    (folder / "readme.txt").write_text("no image")
    return folder


def add_poses(clip):
    """Write a poses.json, its images as the first two of the clip."""
    known = json.loads((OFFICE / "poses.json").read_text())
    frames = [
        {"file": name, "pose": known["poses"][source]}
        for name, source in (("9.jpg", "00184.jpg"), ("10.jpg", "00185.jpg"))
    ]
    table = {"image_size": [540, 360], "K": known["K"], "frames": frames}
    (clip / "poses.json").write_text(json.dumps(table))


def test_a_folder_becomes_a_video_and_json_lines_in_natural_order(capsys, clip, tmp_path):
    out_file, lines = tmp_path / "out.mp4", tmp_path / "lines"
    code, out, err = run(capsys, clip, "-o", out_file, "--json-lines", lines, "--rate", "5")
    assert (code, err) == (0, "")
    assert out.startswith(f"{out_file}: 3 frames: ")
    records = records_of(lines)
    assert [(r["frame"], r["file"], r["time_s"]) for r in records] == [
        (0, "9.jpg", 0.0),
        (1, "10.jpg", 0.2),
        (2, "11.jpg", 0.4),
    ]
    assert all(set(record) == KEYS for record in records)
    assert records[0]["reason"] == "no_earlier_frame"
    assert records[1]["earlier_time_s"] == 0.0
    assert records[1]["diagnostics"]["n_after_angle"] >= 100
    pictures = pictures_of(out_file)
    assert [picture.shape for picture in pictures] == [(360, 540, 3)] * 3
    assert cv2.VideoCapture(str(out_file)).get(cv2.CAP_PROP_FPS) == pytest.approx(5.0)
    source = cv2.imread(str(clip / "10.jpg"))
    shown = pictures[1][200:].astype(int)
    assert np.median(np.abs(shown - (0.6 * source[200:]).astype(int))) < 12, "the frame itself, darkened"


def test_poses_beside_the_images_are_used_unless_told_otherwise(capsys, clip, tmp_path):
    add_poses(clip)
    lines = tmp_path / "lines"
    found = {}
    for more in ((), ("--no-poses",)):
        code, _, err = run(
            capsys, clip, "-o", tmp_path / "o.mp4", "--json-lines", lines, "--limit", "2", *more
        )
        assert (code, err) == (0, "")
        found[more] = records_of(lines)[1]
    assert found[()]["baseline_m"] == pytest.approx(0.1128, abs=1e-3)
    assert found[("--no-poses",)]["baseline_m"] is None
    turned, plain = (found[key]["diagnostics"]["median_flow_px"] for key in ((), ("--no-poses",)))
    assert turned < 0.8 * plain, "the rotation is taken out"


def test_the_parallax_method_draws_its_map_where_poses_are_known(capsys, clip, tmp_path):
    add_poses(clip)
    pictures = {}
    for more in ((), ("--method", "parallax")):
        out_file, lines = tmp_path / "o.mp4", tmp_path / "lines"
        code, _, err = run(capsys, clip, "-o", out_file, "--json-lines", lines, "--limit", "2", *more)
        assert (code, err) == (0, "")
        pictures[more] = pictures_of(out_file)[1]
    assert all(set(record) == KEYS for record in records_of(lines))
    assert records_of(lines)[1]["kind"] in ("gap", "single_plane")
    corner = pictures[("--method", "parallax")][-40:, -40:]
    assert np.median(corner) > 200, "the map from above, on white"
    assert np.median(pictures[()][-40:, -40:]) < 200


def test_several_methods_are_panels_of_one_film_and_lines_of_their_own(capsys, clip, tmp_path):
    add_poses(clip)
    out_file, lines = tmp_path / "o.mp4", tmp_path / "lines"
    names = ["paper", "parallax", "straight", "flow_balance", "line_vp"]
    more = ["--method", "paper,parallax, straight", "--method", "flow_balance,line_vp", "--limit", "2"]
    code, out, err = run(capsys, clip, "-o", out_file, "--json-lines", lines, *more)
    assert (code, err) == (0, "")
    records = records_of(lines)
    assert [(r["frame"], r["method"]) for r in records] == [(n, name) for n in (0, 1) for name in names]
    assert all(set(record) == KEYS for record in records)
    assert {r["reason"] for r in records[:5]} == {"no_earlier_frame"}, "all have the same pairs"
    second = {r["method"]: r for r in records[5:]}
    assert {r["earlier_time_s"] for r in second.values()} == {0.0}
    assert len({r["baseline_m"] for r in second.values()}) == 1
    assert (second["straight"]["kind"], second["straight"]["x_px"]) == ("straight_ahead", 269.5)
    assert second["straight"]["diagnostics"] is None
    assert second["paper"]["diagnostics"]["n_after_angle"] >= 100
    for name in names:
        kind = second[name]["kind"]
        assert f"{name}: " + ("none 2" if kind == "none" else f"none 1, {kind} 1") in out
    first, _ = pictures_of(out_file)
    assert first.shape[1] > 3 * 540
    assert first.shape[0] > 2 * 360


def test_a_method_named_wrongly_is_one_clear_line(capsys, clip, tmp_path):
    out = tmp_path / "n.mp4"
    known = "allowed are paper, parallax, straight, flow_balance, line_vp"
    for arguments, words in (
        (("--method", "magic"), f"--method: found 'magic', {known}"),
        (("--method", "paper,"), f"--method: found '', {known}"),
        (("--method", "paper", "--method", "line_vp,paper"), "--method: found paper 2 times"),
        (("--method", "parallax", "--baseline-frames", "1"), "--baseline-frames: only with --method paper"),
        (("--method", "paper,line_vp", "--baseline-frames", "1"), "--baseline-frames: only with"),
    ):
        code, printed, err = run(capsys, clip, "-o", out, *arguments)
        assert (code, printed) == (2, ""), arguments
        assert len(err.splitlines()) == 1, err
        assert words in err, err
    assert not out.exists()


def test_a_folder_that_holds_its_images_in_a_folder_of_that_name(capsys, clip, tmp_path):
    walk = tmp_path / "walk"
    walk.mkdir()
    add_poses(clip)
    (clip / "poses.json").rename(walk / "poses.json")
    clip.rename(walk / "images")
    lines = tmp_path / "lines"
    for source in (walk, walk / "images"):
        assert run(capsys, source, "-o", tmp_path / "o.mp4", "--json-lines", lines, "--limit", "2")[0] == 0
        assert records_of(lines)[1]["baseline_m"] is not None


def test_a_video_is_read_with_its_own_rate_and_a_step_can_be_asked_for(capsys, clip, tmp_path):
    first, second, lines = tmp_path / "first.avi", tmp_path / "second.mkv", tmp_path / "lines"
    assert run(capsys, clip, "-o", first, "--rate", "4", "--no-poses")[0] == 0
    code, _, err = run(
        capsys, first, "-o", second, "--json-lines", lines, "--baseline-frames", "2", "--hfov", "60"
    )
    assert (code, err) == (0, "")
    records = records_of(lines)
    assert [r["time_s"] for r in records] == pytest.approx([0.0, 0.25, 0.5])
    assert [r["earlier_time_s"] for r in records] == [None, None, 0.0]
    assert {r["file"] for r in records} == {None}
    assert len(pictures_of(second)) == 3


def test_a_video_that_ends_early_says_how_much_of_it_there_was(capsys, clip, tmp_path):
    whole, torn = tmp_path / "whole.avi", tmp_path / "torn.avi"
    assert run(capsys, clip, "-o", whole, "--no-poses")[0] == 0
    data = whole.read_bytes()
    torn.write_bytes(data[: len(data) // 2])
    code, out, err = run(capsys, torn, "-o", tmp_path / "o.mp4")
    assert (code, err) == (0, "")
    written = len(pictures_of(tmp_path / "o.mp4"))
    assert 0 < written < 3
    assert out.startswith(f"{tmp_path / 'o.mp4'}: {written} frames (the source states 3): ")


def test_frames_of_other_sizes_are_shown_whole(capsys, clip, tmp_path):
    small = np.full((100, 300), 99, np.uint8)
    cv2.imwrite(str(clip / "12.png"), small)
    lines = tmp_path / "lines"
    assert run(capsys, clip, "-o", tmp_path / "o.mp4", "--json-lines", lines)[0] == 0
    assert len(pictures_of(tmp_path / "o.mp4")) == 4
    assert records_of(lines)[3]["kind"] == "none"


def test_what_cannot_be_read_or_written_is_one_clear_line(capfd, clip, tmp_path):
    garbage = tmp_path / "garbage.mp4"
    garbage.write_bytes(b"no video at all")
    empty = tmp_path / "empty"
    empty.mkdir()
    bad_poses = tmp_path / "bad"
    bad_poses.mkdir()
    (bad_poses / "1.jpg").write_bytes((clip / "9.jpg").read_bytes())
    (bad_poses / "poses.json").write_text('{"frames": 3}')
    out = tmp_path / "o.mp4"
    for arguments, words in (
        ((garbage, "-o", out), "garbage.mp4"),
        ((tmp_path / "none.mp4", "-o", out), "none.mp4"),
        ((empty, "-o", out), "no images"),
        ((bad_poses, "-o", out), "poses.json"),
        ((clip, "-o", tmp_path / "o.words"), "'.words'"),
        ((clip, "-o", tmp_path / "none" / "o.mp4"), "none"),
        ((clip, "-o", out, "--codec", "ZZZZ"), "the codec ZZZZ cannot be opened"),
        ((clip, "-o", out, "--json-lines", tmp_path / "none" / "lines"), "--json-lines"),
        ((clip, "-o", out, "--preset", "best"), "preset"),
        ((clip, "-o", out, "--hfov", "400"), "--hfov"),
    ):
        code, printed, err = run(capfd, *arguments)
        assert (code, printed) == (2, ""), arguments
        assert len(err.splitlines()) == 1, err
        assert words in err, err
    assert not out.exists()
    out.write_bytes((tmp_path / "garbage.mp4").read_bytes())
    code, _, err = run(capfd, out, "-o", out)
    assert code == 2
    assert "source itself" in err
    assert out.read_bytes() == b"no video at all"


def test_a_frame_that_cannot_be_decoded_ends_the_clip_and_what_was_written_plays(capsys, clip, tmp_path):
    (clip / "11.jpg").write_text("no image")
    code, _, err = run(capsys, clip, "-o", tmp_path / "o.mp4")
    assert code == 2
    assert "11.jpg" in err
    assert len(pictures_of(tmp_path / "o.mp4")) == 2


@pytest.mark.parametrize(
    "arguments", [["--limit", "0"], ["--baseline-frames", "x"], ["--rate", "nan"], ["--codec", "long one"]]
)
def test_a_command_line_that_is_none_is_refused(capsys, clip, arguments):
    with pytest.raises(SystemExit) as exit_:
        main(["video", str(clip), "-o", "o.mp4", *arguments])
    assert exit_.value.code == 2
    assert arguments[0] in capsys.readouterr().err


@pytest.mark.parametrize(("ended_by", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_leaves_a_file_that_plays(clip, tmp_path, ended_by, code):
    for number in range(12, 1000):
        (clip / f"{number}.jpg").symlink_to(clip / "9.jpg")
    out, lines = tmp_path / "o.mp4", tmp_path / "lines"
    # A process started by one that ignores the signals would ignore them too.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "signal.signal(signal.SIGTERM, signal.SIG_DFL); "
        "from detector.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "video", clip, "-o", out, "--json-lines", lines]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            deadline = time.monotonic() + 60.0
            while not (lines.exists() and len(lines.read_text().splitlines()) > 4):
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < deadline
                time.sleep(0.02)
            process.send_signal(ended_by)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == code
    written = len(pictures_of(out))
    assert 4 < written < 1000
    assert err.splitlines() == [f"detector: interrupted: {out} holds {written} frames"]
    assert len(records_of(lines)) == written, "the frame in hand is finished"


@pytest.fixture
def usual_signals():
    """As a shell starts a program, whatever the tests were started by."""
    usual = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield usual
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_second_signal_does_not_wait_for_the_frame_but_for_the_file(usual_signals):
    with stop_request() as stop:
        assert stop.by is None
        signal.raise_signal(signal.SIGTERM)
        assert (stop.by, stop.exit_code) == (signal.SIGTERM, 143)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        stop.hurry = False
        signal.raise_signal(signal.SIGINT)  # noted, no more
        assert stop.exit_code == 143, "the first one says"
    assert {number: signal.getsignal(number) for number in usual_signals} == usual_signals


def test_a_signal_that_was_told_to_be_ignored_stays_so(usual_signals):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    with stop_request() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.by is None
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
