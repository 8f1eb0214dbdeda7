"""Calibration with rendered boards: what comes out is the camera that they were rendered by."""

import contextlib
import itertools
import json
import resource
import shutil
import socket
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.calibrate.board import CharucoBoard, Chessboard, View, board_from_words
from companion.calibrate.collect import ViewCollector
from companion.calibrate.judge import doubts
from companion.calibrate.solve import calibrate, coverage, view_errors_px
from companion.cli import main
from companion.errors import CompanionError
from companion.frames.socket import frame_bytes
from detector.camera_model import CameraModel
from tests.fakes.board_views import BoardStudio, charuco_texture, chessboard_texture, poses

TRUE = CameraModel(640, 480, 452.0, 455.0, 325.5, 236.0, (-0.28, 0.09, 0.0006, -0.0004, -0.01))
SQUARE_M = 0.024


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Sixteen pictures of a chessboard of 9 x 6 inner corners by TRUE."""
    path = tmp_path_factory.mktemp("views")
    studio = BoardStudio(TRUE, chessboard_texture(9, 6), SQUARE_M)
    for number, (offset_px, distance_m, tilt_deg) in enumerate(poses(TRUE)):
        cv2.imwrite(str(path / f"{number}.png"), studio.picture(offset_px, distance_m, tilt_deg))
    return path


@pytest.fixture(scope="module")
def views(folder) -> list[View]:
    board = Chessboard(9, 6, SQUARE_M)
    found = [board.find(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in sorted(folder.glob("*.png"))]
    return [view for view in found if view is not None]


def largest_angle_deg(model: CameraModel, true: CameraModel = TRUE) -> float:
    """How far apart two cameras say that the same pixel looks, at most, once their axes are aligned as well as can be."""
    y, x = np.mgrid[20 : true.height_px - 20 : 20, 20 : true.width_px - 20 : 20]
    points = np.column_stack((x.ravel(), y.ravel())).astype(float)
    first, second = model.pixel_to_ray(points), true.pixel_to_ray(points)
    u, _, vt = np.linalg.svd(first.T @ second)
    return float(np.degrees(np.linalg.norm(np.cross(first @ (u @ vt), second), axis=1).max()))


def test_the_corners_are_found_to_a_part_of_a_pixel(views):
    assert len(views) >= 14
    errors = np.concatenate([view_errors_px(TRUE, view) for view in views])
    assert np.sqrt(np.mean(errors**2)) < 0.05


def test_the_camera_that_rendered_the_boards_comes_out(views):
    found = calibrate(views, 640, 480)
    assert found.rms_px < 0.1
    assert found.model.fx_px == pytest.approx(TRUE.fx_px, rel=0.003)
    assert found.model.fy_px == pytest.approx(TRUE.fy_px, rel=0.003)
    assert (found.model.cx_px, found.model.cy_px) == pytest.approx((TRUE.cx_px, TRUE.cy_px), abs=1.5)
    assert largest_angle_deg(found.model) < 0.1
    assert found.focal_sigma < 0.002


def test_a_view_that_does_not_fit_is_left_out(views):
    bent = View(
        views[0].board_m,
        views[0].image_px + np.random.default_rng(1).normal(0, 4, (54, 2)).astype(np.float32),
    )
    found = calibrate([*views, bent], 640, 480)
    assert (found.left_out, len(found.used)) == (1, len(views))
    assert largest_angle_deg(found.model) < 0.1


def test_too_few_views_are_refused(views):
    with pytest.raises(CompanionError, match="found in 5 views; at least 6 are needed"):
        calibrate(views[:5], 640, 480)


def test_a_charuco_board_is_used_also_where_it_reaches_beyond_the_image():
    studio = BoardStudio(TRUE, charuco_texture(9, 7), SQUARE_M)
    board = CharucoBoard(9, 7, SQUARE_M, 0.75 * SQUARE_M, "4x4_50")
    found = [
        board.find(studio.picture((1.4 * x, 1.4 * y), 0.8 * distance_m, tilt_deg))
        for (x, y), distance_m, tilt_deg in poses(TRUE)
    ]
    views = [view for view in found if view is not None]
    assert len(views) >= 14
    assert min(len(view.board_m) for view in views) < 48  # of some, a part was out of the image
    calibrated = calibrate(views, 640, 480)
    assert largest_angle_deg(calibrated.model) < 0.25
    assert calibrated.model.fx_px == pytest.approx(TRUE.fx_px, rel=0.006)


def test_the_command_makes_a_camera_file_that_the_detector_reads_and_judges_it(folder, tmp_path, capsys):
    out = tmp_path / "camera.toml"
    assert main(["calibrate", str(folder), "-o", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["grade"], result["file"], result["images"]) == ("good", str(out), 16)
    assert largest_angle_deg(CameraModel.from_file(out)) < 0.1
    assert out.read_text().startswith("# Calibrated from ")
    picture = cv2.imread(str(tmp_path / "camera.png"))
    assert picture.shape == (480, 640, 3)
    assert picture.any(axis=2).mean() > 0.5

    assert main(["calibrate", "--check", str(out), str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["grade"] == "good"
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("width_px = 640\nheight_px = 480\nhfov_deg = 95.0\n")
    assert main(["calibrate", "--check", str(wrong), str(folder)]) == 1
    said = capsys.readouterr().out
    assert said.startswith("bad: ")
    assert "focal length -35" in said
    assert main(["calibrate", "--check", str(wrong)]) == 0  # nothing speaks against its figures by themselves
    assert capsys.readouterr().out.startswith("good: ")


def test_a_full_disk_leaves_the_camera_file_that_is_there(folder, tmp_path, capsys):
    out = tmp_path / "camera.toml"
    out.write_text("# the good one\n")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (0, hard)
    )  # no file may grow: what a full disk does to a program
    try:
        code = main(["calibrate", str(folder), "-o", str(out), "--picture", "/dev/null"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 1
    assert f"{out}: cannot be written: File too large" in capsys.readouterr().err
    assert out.read_text() == "# the good one\n"
    assert [path.name for path in tmp_path.iterdir()] == ["camera.toml"]


def test_views_from_one_place_only_are_not_called_good(folder, tmp_path, capsys):
    few = tmp_path / "few"
    few.mkdir()
    for number in range(6):  # always the same three, all at the left
        shutil.copy(folder / f"{(1, 9, 15)[number % 3]}.png", few / f"{number}.png")
    out = tmp_path / "few.toml"
    assert main(["calibrate", str(few), "-o", str(out), "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["grade"] == "bad"
    assert not out.exists()
    assert any("hold the board also" in advice for advice in result["advice"])


def test_a_live_camera_is_asked_for_still_and_different_views():
    corners = np.zeros((10, 3), np.float32)
    corners[:, 0] = np.arange(10)

    def at(x_px: float) -> View:
        return View(corners, np.column_stack((corners[:, 0] * 10 + x_px, corners[:, 0])).astype(np.float32))

    live = ViewCollector(640, needs_stillness=True)
    offered = [at(0), at(0.5), at(1), at(60), at(120), at(121), None, at(300), at(300.5)]
    assert [live.offer(view) for view in offered] == [
        False,
        True,
        False,
        False,
        False,
        True,
        False,
        False,
        True,
    ]
    video = ViewCollector(640, needs_stillness=False)
    assert [video.offer(view) for view in offered] == [
        True,
        False,
        False,
        True,
        True,
        False,
        False,
        True,
        False,
    ]


@contextlib.contextmanager
def held_before_a_camera(folder: Path, each_s: float):
    """Serve the pictures of a folder as a camera would, each for some time, over and over; yield the source's URL."""
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.glob("*.png"))]
    stopping = threading.Event()
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(30)

    def send() -> None:
        with contextlib.suppress(OSError), listener.accept()[0] as connection:
            for seq in itertools.count():
                if stopping.wait(0.02):
                    return
                image = images[int(seq * 0.02 / each_s) % len(images)]
                connection.sendall(frame_bytes(image, seq=seq, time_ns=time.monotonic_ns()))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield f"tcp:127.0.0.1:{listener.getsockname()[1]}"
    finally:
        stopping.set()
        thread.join()
        listener.close()


def test_a_live_camera_is_calibrated_with_views_of_a_board_at_rest(folder, tmp_path, capsys):
    out = tmp_path / "live.toml"
    with held_before_a_camera(folder, 0.4) as url:
        code = main(["calibrate", url, "--views", "8", "-o", str(out), "--json"])
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["views"] + result["left_out"] == 8
    assert said.err.count("\n") == 8
    assert "view 8 of 8; " in said.err
    assert (code == 0) is out.exists() is (result["grade"] != "bad")
    assert result["rms_px"] < 0.1


def test_the_emptiest_place_is_where_nothing_was_seen(views):
    upper_left = View(np.zeros((1, 3), np.float32), np.zeros((1, 2), np.float32))
    seen = coverage([upper_left], 640, 480)
    assert seen.cells.sum() == 1
    assert seen.emptiest_place == "upper middle"
    assert coverage(views, 640, 480).fraction > 0.7


def test_figures_that_are_unusual_by_themselves_are_doubted():
    assert doubts(TRUE) == ()
    stretched, cropped = doubts(CameraModel(640, 480, 450.0, 400.0, 230.0, 239.5))
    assert "fx / fy is 1.125" in stretched
    assert "cx_px is 14% of the side from the middle" in cropped


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--board", "9"], "--board: found '9'; allowed: COLUMNSxROWS"),
        (["--square", "24"], "--square: found '24'; allowed: 1mm to 1m with its unit"),
        (["--charuco", "4X4_50"], "--marker: needed with --charuco"),
        (["--charuco", "nine", "--marker", "18mm"], "--charuco: found 'nine'; allowed: 4X4_100"),
        (["--charuco", "4X4_50", "--marker", "30mm"], "--marker: found 30 mm; allowed: above 0 and below the square's 24 mm"),
        (["--views", "2"], "--views: found 2; allowed: 6 to 1000"),
        (["--check", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ],
)  # fmt: skip
def test_wrong_words_are_one_clear_line(words, message, capsys, tmp_path):
    assert main(["calibrate", str(tmp_path), *words]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_source_that_is_missing_or_without_a_board_is_one_clear_line(capsys, tmp_path):
    assert main(["calibrate"]) == 1
    assert "SOURCE is missing" in capsys.readouterr().err
    assert main(["calibrate", "nowhere"]) == 1
    assert "nowhere: no such file or folder, and no source.url" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((48, 64), np.uint8))
    assert main(["calibrate", str(tmp_path)]) == 1
    assert "the board was found in 0 views" in capsys.readouterr().err
    assert isinstance(board_from_words("9x6", "2.4cm", "", ""), Chessboard)
