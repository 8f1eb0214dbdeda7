"""``detector report``: files that belong together, and one clear line for input that cannot be used."""

import json
import re
from pathlib import Path

import cv2
import pytest

from detector.cli import main
from detector.commands.side_by_side_table import known_pair
from detector.params import DetectorParams
from detector.pipeline import VoidDetector

PAIRS = Path(__file__).parents[2] / "data" / "pairs"
OFFICE = [str(PAIRS / "office" / name) for name in ("00068.jpg", "00069.jpg")]
BRICKS = [str(PAIRS / "brickwall" / name) for name in ("001.jpg", "003.jpg")]


def run(capsys, *arguments):
    code = main(["report", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def report_of(folder):
    return json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)


def test_tables_figures_and_json_of_one_pair(capsys, tmp_path):
    folder = tmp_path / "new" / "report"
    file = tmp_path / "params.toml"
    file.write_text(
        "vote_tolerance = 10.0\nplane_deviation_px_at_1280 = 0.0\n"
    )  # no plane, and a candidate is elected
    params = DetectorParams.from_toml(file, "paper")
    code, out, err = run(capsys, *OFFICE, "-o", folder, "--preset", "paper", "--params", file, "--loops", "1")
    assert (code, err) == (0, "")
    assert out.strip() == str(folder / "report.md")

    text = (folder / "report.md").read_text()
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert pictures == [f"figure-{number}.png" for number in (3, 4, 5, 6)]
    for name in pictures:
        assert min(cv2.imread(str(folder / name)).shape[:2]) > 500

    report = report_of(folder)
    images = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in OFFICE]
    found = VoidDetector(params).detect(*images).detection.diagnostics
    assert report["table_1"] == {key: getattr(found, key) for key in report["table_1"]}
    assert set(report["table_1"]) >= {"p", "n", "k", "n_tracks", "n_after_angle"}
    assert f"| {found.p} | {found.n} | {found.k} | {found.n_tracks} |" in text
    for kind in ("first", "other"):
        loop = report["table_2"][kind]
        assert loop["total_calls"] == sum(step["calls"] for step in loop["steps"].values())
        assert all(step["seconds"] > 0.0 for step in loop["steps"].values())
        assert set(loop["steps"]) >= {"features", "flow", "clusters", "lines", "vote"}
    assert f"{report['table_2']['first']['total_calls']:,}" in text
    assert report["answer"]["kind"] == "vanishing_point"
    elected = [item for item in report["candidates"] if item["role"] == "elected"]
    assert [(item["x_px"], item["y_px"]) for item in elected] == [
        (report["answer"]["x_px"], report["answer"]["y_px"])
    ]
    assert [item["p"] for item in report["decisions"]["p"]] == list(range(1, 10))
    assert max(report["decisions"]["n"], key=lambda item: item["ch_over_db"])["n"] == found.n
    assert report["decisions"]["k"][0]["largest_change"] is None


def test_a_figure_of_an_earlier_run_does_not_stay_beside_another_pair(capsys, tmp_path):
    stale = tmp_path / "figure-6.png"
    stale.write_bytes(b"of another pair")
    other = tmp_path / "notes.txt"
    other.write_text("mine")
    assert run(capsys, *BRICKS, "-o", tmp_path, "--loops", "1")[0] == 0
    report = report_of(tmp_path)
    assert report["answer"]["kind"] == "single_plane"
    assert sorted(report["pictures"]) == ["figure-3", "figure-4", "figure-5"]
    assert not stale.exists()
    assert other.read_text() == "mine"
    assert "figure-6" in (tmp_path / "report.md").read_text(), "it says that it was not drawn"


def test_no_answer_is_a_report_too(capsys, tmp_path):
    code, _, err = run(capsys, OFFICE[0], BRICKS[0], "-o", tmp_path, "--loops", "1")
    assert (code, err) == (0, "")
    report = report_of(tmp_path)
    assert (report["answer"]["reason"], report["pictures"]) == ("wrong_size", {})
    assert "wrong_size" in (tmp_path / "report.md").read_text()


def test_a_known_rotation_is_taken_out(capsys, tmp_path):
    names = ("00193.jpg", "00194.jpg")
    known = json.loads((PAIRS / "office" / "poses.json").read_text())
    (ax, ay, az), (bx, by, bz) = ([row[:3] for row in known["poses"][name][:3]] for name in names)
    rotation = [
        [sum(b[i] * a[j] for a, b in ((ax, bx), (ay, by), (az, bz))) for j in range(3)] for i in range(3)
    ]
    file = tmp_path / "rotation.json"
    file.write_text(json.dumps({"later_from_earlier": rotation}))
    pair = [PAIRS / "office" / name for name in names]
    flows = []
    for more in ([], ["--rotation", file]):
        assert run(capsys, *pair, "-o", tmp_path, "--loops", "1", "--hfov", "57.2", *more)[0] == 0
        flows.append(report_of(tmp_path)["answer"]["diagnostics"]["median_flow_px"])
    assert flows[1] < 0.8 * flows[0]


METHODS = ["paper", "parallax", "straight", "flow_balance", "line_vp"]


def side_by_side_of(folder):
    text = (folder / "report.md").read_text().split("## Side by side")[1]
    cells = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    return report_of(folder)["side_by_side"], {row[0].strip("`"): row for row in cells}


def test_all_methods_stand_side_by_side_and_are_judged_where_the_truth_lies_beside_the_images(
    capsys, tmp_path
):
    assert run(capsys, *BRICKS, "-o", tmp_path, "--loops", "1")[0] == 0
    found, rows = side_by_side_of(tmp_path)
    assert (found["loops"], found["told"], found["truth"]) == (1, [], "brickwall")
    assert [row["method"] for row in found["methods"]] == list(rows) == METHODS
    for row in found["methods"]:
        wall = row["kind"] == "single_plane"
        assert row["right"] is (None if row["kind"] == "none" else wall), "the truth is a wall"
        word = {True: "right", False: "wrong", None: "no answer"}[row["right"]]
        assert rows[row["method"]][-1] == word
        assert rows[row["method"]][4] in (f"{1e3 * row['seconds']:.1f} ms", "< 0.1 ms")
    by_name = {row["method"]: row for row in found["methods"]}
    answer = report_of(tmp_path)["answer"]
    assert by_name["paper"]["kind"] == answer["kind"] == "single_plane"
    assert by_name["paper"]["time_to_contact_frames"] == answer["time_to_contact_frames"]
    assert by_name["straight"]["right"] is False
    assert rows["straight"][2] == "128, 128"
    assert rows["paper"][4] == f"{1e3 * by_name['paper']['seconds']:.1f} ms"

    assert run(capsys, *BRICKS, "-o", tmp_path, "--loops", "1", "--no-truth")[0] == 0
    found, rows = side_by_side_of(tmp_path)
    assert found["truth"] is None
    assert {row[-1] for row in rows.values()} == {"not known"}


def test_a_truth_beside_the_images_that_cannot_be_used_is_one_clear_line(capsys, tmp_path):
    folder = tmp_path / "walk" / "images"
    folder.mkdir(parents=True)
    pair = [folder / f"{index}.jpg" for index in (1, 2)]
    for file, source in zip(pair, BRICKS, strict=True):
        file.write_bytes(Path(source).read_bytes())
    truth = tmp_path / "walk" / "groundtruth.json"
    frames = {f"images/{file.name}": {"no_motion": True} for file in pair}
    for content, words in (
        ("{", "is not valid JSON"),
        (json.dumps({"image_size": [256, 256], "frames": 3}), "frames"),
        (
            json.dumps({"image_size": [64, 64], "frames": frames}),
            "image_size: found (64, 64), 2.jpg has (256, 256)",
        ),
    ):
        truth.write_text(content)
        code, out, err = run(capsys, *pair, "-o", tmp_path / "out")
        assert (code, out) == (2, "")
        assert len(err.splitlines()) == 1, err
        assert words in err
        assert "--no-truth" in err
        assert not (tmp_path / "out").exists()
    truth.write_text(json.dumps({"image_size": [256, 256], "frames": frames}))
    found = known_pair(*pair, (256, 256))
    assert (found.pair.a, found.pair.b) == ("images/1.jpg", "images/2.jpg"), "not listed as a pair, yet known"
    assert known_pair(pair[0], Path(BRICKS[1]), (256, 256)) is None, "of another set"


def test_input_that_cannot_be_used_is_one_clear_line(capsys, tmp_path):
    file = tmp_path / "file"
    file.write_text("no folder")
    blocked = tmp_path / "blocked"
    (blocked / "report.json").mkdir(parents=True)
    for arguments, words in (
        ((tmp_path / "none.png", OFFICE[1], "-o", tmp_path), "none.png"),
        ((*BRICKS, "-o", file), str(file)),
        ((*BRICKS, "-o", file / "below"), "below"),
        ((*BRICKS, "-o", blocked, "--loops", "1"), "report.json"),
        ((*BRICKS, "-o", tmp_path, "--preset", "best"), "preset"),
        ((*BRICKS, "-o", tmp_path, "--rotation", file), "--rotation"),
        ((*BRICKS, "-o", tmp_path, "--hfov", "400"), "--hfov"),
    ):
        code, out, err = run(capsys, *arguments)
        assert (code, out) == (2, ""), arguments
        assert len(err.splitlines()) == 1, err
        assert words in err, err


@pytest.mark.parametrize("arguments", [["--loops", "0"], ["--loops", "many"], ["--loops", "1e3"], []])
def test_a_command_line_that_is_none_is_refused(capsys, tmp_path, arguments):
    output = ["-o", str(tmp_path)] if arguments else []
    with pytest.raises(SystemExit) as exit_:
        main(["report", *BRICKS, *output, *arguments])
    assert exit_.value.code == 2
    assert ("--loops" if arguments else "-o") in capsys.readouterr().err
