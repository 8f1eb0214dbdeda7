import os
from pathlib import Path

import pytest
from pydantic import ValidationError

from companion.config import Config, DetectorConfig, GuidanceConfig, LinkConfig, SourceConfig
from companion.config_file import default_toml, parse_config
from companion.config_sources import load_config
from companion.errors import ConfigError


def fault_lines(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, name="f.toml")
    return str(caught.value).splitlines()


def test_the_default_file_reads_back_as_the_defaults():
    assert parse_config(default_toml()) == Config()


def test_an_empty_file_gives_the_defaults():
    assert parse_config("") == Config()


def test_the_default_file_explains_every_key():
    lines = default_toml().splitlines()
    for section, facts in Config.model_fields.items():
        assert f"[{section}]" in lines
        for key, key_facts in facts.annotation.model_fields.items():
            at = next(i for i, line in enumerate(lines) if line.startswith(f"{key} = "))
            comment: list[str] = []
            while lines[at - 1].startswith("# "):
                at -= 1
                comment.insert(0, lines[at][2:])
            words = " ".join(comment)
            assert words.startswith(key_facts.description.strip().split()[0]), key
            assert "Allowed: " in words, key
            assert "Default: " in words, key


def test_no_line_of_the_default_file_is_too_long_to_read():
    assert max(len(line) for line in default_toml().splitlines()) <= 110


def test_an_integer_does_for_a_float():
    config = parse_config("[camera]\nhfov_deg = 90")
    assert config.camera.hfov_deg == 90.0
    assert isinstance(config.camera.hfov_deg, float)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[camera]\nhfov_deg = 200", "camera.hfov_deg: found 200; allowed: number above 5 and below 170"),
        ("[camera]\nhfov_deg = 5.0", "camera.hfov_deg: found 5.0; allowed: number above 5 and below 170"),
        ("[camera]\nhfov_deg = nan", "camera.hfov_deg: found nan; allowed: number above 5 and below 170"),
        ("[camera]\nhfov_deg = true", "camera.hfov_deg: found true; allowed: number above 5 and below 170"),
        ('[camera]\nhfov_deg = "70"', 'camera.hfov_deg: found "70"; allowed: number above 5 and below 170'),
        (
            "[guidance]\nwall_k = 2.0",
            "guidance.wall_k: found 2.0; allowed: whole number from 1 and up to 20",
        ),
        ("[source]\nloop = 1", "source.loop: found 1; allowed: true or false"),
        (
            "[source]\nurl = 3",
            'source.url: found 3; allowed: text such as "v4l2:/dev/video0" or "file:walk.mp4"',
        ),
        (
            "[source]\ncontrols = []",
            'source.controls: found a list; allowed: text such as "auto_exposure=manual_mode, exposure_time_absolute=80"',
        ),
        (
            '[source]\npixel_format = "H264"',
            'source.pixel_format: found "H264"; allowed: one of "auto", "GREY", "YUYV", "UYVY", "NV12", "MJPEG"',
        ),
        (
            '[source]\nurl = "walk.mp4"',
            (
                'source.url: found "walk.mp4"; allowed: SCHEME:WHERE with one of the schemes '
                "v4l2, picamera2, rtsp, rtsps, udp, gst, file, tcp"
            ),
        ),
        (
            '[source]\nurl = "v4l2:video0"',
            'source.url: found "v4l2:video0"; allowed: v4l2:PATH with the whole path of a device, such as v4l2:/dev/video0',
        ),
        (
            '[source]\nurl = "picamera2:"',
            'source.url: found "picamera2:"; allowed: picamera2:NUMBER, 0 for the first camera',
        ),
        (
            '[source]\nurl = "rtsp:cam"',
            'source.url: found "rtsp:cam"; allowed: rtsp://HOST:PORT and what follows',
        ),
        ('[source]\nurl = "gst:"', 'source.url: found "gst:"; allowed: something after gst:'),
        (
            '[source]\ncontrols = "gain 3"',
            'source.controls: found "gain 3"; allowed: NAME=VALUE, NAME=VALUE with names as `companion cameras` lists them',
        ),
        (
            "[source]\nwidth_px = 640",
            "source.height_px: found 0; allowed: both sizes or neither: width_px is set",
        ),
        (
            "[guidance]\nvelocity_horizon_s = 0.2",
            "guidance.velocity_horizon_s: found 0.2; allowed: 0 (the autopilot's own), or from 0.5 to 10",
        ),
        (
            "[link]\nsigning_link_id = 256",
            "link.signing_link_id: found 256; allowed: whole number from 0 and up to 255",
        ),
        (
            '[link]\nautopilot = "serial:x"',
            'link.autopilot: found "serial:x"; allowed: serial:/dev/serial/by-id/NAME:BAUD',
        ),
        (
            '[link]\nplanner = ["udpin:h:1", "tcp:h"]',
            "link.planner: found a list; allowed: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT",
        ),
        (
            '[link]\nfilters = ["deny out planner message=9-3"]',
            "link.filters: found a list; allowed: message ids from 0 to 16777215, the lower one first",
        ),
        (
            '[link]\nplanner = "udpout:h:0"',
            'link.planner: found "udpout:h:0"; allowed: a port from 1 to 65535',
        ),
        (
            '[source]\nurl = "tcp:here"',
            'source.url: found "tcp:here"; allowed: tcp:HOST:PORT with a port from 1 to 65535',
        ),
        ("camera = 5", "camera: found 5; allowed: a table, [camera]"),
        ("[camera]\nhfov = 70", "camera.hfov: unknown key; did you mean camera.hfov_deg?"),
        ("[source]\nhfov_deg = 70", "source.hfov_deg: unknown key; did you mean camera.hfov_deg?"),
        ("[cammera]\nx = 1", "cammera: unknown table; did you mean camera?"),
        (
            "zzz = 1",
            "zzz: unknown key; allowed here: source, camera, detector, link, guidance, interception, engagement, ground_station, log, status, reload",
        ),
        ('[camera]\n"a b" = 70', 'camera."a b": unknown key; allowed here: hfov_deg, file, mount_roll_deg,'),
    ],
)
def test_a_fault_names_file_key_found_and_allowed(text: str, line: str):
    (found,) = fault_lines(text)
    assert found.startswith(f"f.toml: {line}")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "[guidance]\nwall_k = 5\nwall_n = 4",
            "guidance.wall_k: found 5; allowed: at most wall_n, which is 4",
        ),
        (
            "[guidance]\ndetection_max_age_s = 20",
            "guidance.detection_max_age_s: found 20.0; allowed: at most detection_max_age_hover_s, which is 10.0",
        ),
        (
            "[detector]\nrestart_delay_s = 9",
            "detector.restart_delay_s: found 9.0; allowed: at most restart_delay_max_s, which is 5.0",
        ),
        (
            '[link]\nplanner = "udpin:h:1"\nautopilot = "udpin:h:1"',
            'link.autopilot: found "udpin:h:1"; allowed: another endpoint than planner\'s',
        ),
        (
            "[camera]\nhfov_deg = 50",
            "guidance.turn_step_deg: found 30.0; allowed: at most half of camera.hfov_deg, which is 25",
        ),
    ],
)
def test_keys_that_cannot_hold_together_are_faults(text: str, line: str):
    assert fault_lines(text) == [f"f.toml: {line}"]


def test_all_faults_come_at_once_one_a_line():
    lines = fault_lines(
        "x = 1\n[camera]\nhfov = 3\nhfov_deg = 200\n[guidance]\nwall_k = 5\nwall_n = 3\n"
        'detection_max_age_s = 60\n[link]\nplanner = "udpin:a:99999"\n'
    )
    keys = [line.split(": ")[1] for line in lines]
    assert sorted(keys) == [
        "camera.hfov",
        "camera.hfov_deg",
        "guidance.detection_max_age_s",
        "guidance.wall_k",
        "link.planner",
        "x",
    ]
    assert all(line.startswith("f.toml: ") for line in lines)


def test_the_models_refuse_disagreeing_keys_wherever_they_are_made():
    with pytest.raises(ValidationError, match="wall_k: found 5"):
        GuidanceConfig(wall_k=5, wall_n=3)
    with pytest.raises(ValidationError, match="restart_delay_s"):
        DetectorConfig(restart_delay_s=2.0, restart_delay_max_s=1.0)
    with pytest.raises(ValidationError, match="HOST:PORT"):
        SourceConfig(url="tcp:h:66000")


def test_two_ephemeral_ports_are_not_the_same_endpoint():
    assert LinkConfig(planner="udpin:127.0.0.1:0", autopilot="udpin:127.0.0.1:0").planner.endswith(":0")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[camera\n", "line 1, column 8"),
        ("[camera]\nhfov_deg = \n", "line 2, column 12"),
        ("a = 1\na = 2\n", "line 2"),
        ("a = " + "[" * 20_000, "nested too deeply"),
        ("a = " + "9" * 5_000, "digits"),
    ],
)
def test_what_is_not_toml_is_said_with_its_place(text: str, words: str):
    (line,) = fault_lines(text)
    assert line.startswith("f.toml: not valid TOML: ")
    assert words in line


def test_a_long_value_is_cut_in_the_message():
    (line,) = fault_lines(f'[source]\npixel_format = "{"x" * 10_000}"')
    assert len(line) < 200


def test_files_that_cannot_be_read_are_named(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"missing\.toml: no such file"):
        load_config(tmp_path / "missing.toml")
    with pytest.raises(ConfigError, match="is a folder"):
        load_config(tmp_path)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config("a\0b")
    with pytest.raises(ConfigError, match="larger than"):
        load_config("/dev/zero")
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b"# ok\n# \xe9t\xe9\n")
    with pytest.raises(ConfigError, match=r"latin\.toml: not UTF-8 text: byte 0xe9 in line 2"):
        load_config(latin)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_file_is_named(tmp_path: Path):
    path = tmp_path / "secret.toml"
    path.write_text("")
    path.chmod(0)
    with pytest.raises(ConfigError, match="cannot be read: Permission denied"):
        load_config(path)


def test_a_byte_order_mark_is_no_fault(tmp_path: Path):
    path = tmp_path / "f.toml"
    path.write_bytes(b"\xef\xbb\xbf[log]\nlevel = 'debug'\n")
    assert load_config(path).log.level == "debug"


def test_relative_paths_are_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "f.toml").write_text(
        "[source]\nurl = 'file:walk'\n[camera]\nfile = '../cam.toml'\n[detector]\nparams_file = '/abs/p.toml'\n"
    )
    monkeypatch.chdir(tmp_path)
    config = load_config("etc/f.toml")
    assert config.source.url == f"file:{tmp_path}/etc/walk"
    assert Path(config.camera.file).resolve() == tmp_path / "cam.toml"
    assert config.detector.params_file == "/abs/p.toml"


def test_an_empty_path_stays_empty(tmp_path: Path):
    (tmp_path / "f.toml").write_text("")
    config = load_config(tmp_path / "f.toml")
    tuned = str(tmp_path / "f.tuned.toml")  # what a ground station sets is kept beside it
    station = Config().ground_station.model_copy(update={"parameters_file": tuned})
    assert config == Config().model_copy(update={"ground_station": station})
