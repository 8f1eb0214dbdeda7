"""The recorder: what is written is what was told, whatever the disk and the end do to it."""

from __future__ import annotations

import gc
import io
import json
import os
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from pymavlink import mavutil

from companion.config import Config
from companion.config.recorder import RecorderConfig
from companion.config_file import parse_config
from companion.errors import ConfigError
from companion.io.messages import Answer, Kind, Message
from companion.recorder import topics
from companion.recorder.disk import MIB, GrowingFile, Limits, make_room, new_name, recordings
from companion.recorder.reading import RecordingError, RecordingFile
from companion.recorder.recording import ChunkLimits, McapFile
from companion.recorder.sink import Recorder, folder_of

HEARTBEAT = bytes.fromhex("fd09000001010100000000000000020c51040332a7")
"""Any whole frame: its checksum is nobody's business here."""


class FakeDesk:
    """Keeps what a sink says."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, dict]] = []
        self.asked: list[tuple[str, dict]] = []
        self.wants = None
        self.dropped: dict[Kind, int] = {}
        self.log = self

    def info(self, event, **fields):
        self.lines.append((event, fields))

    warning = error = info

    def want(self, wants):
        self.wants = wants

    def ask(self, name, fields):
        self.asked.append((name, dict(fields)))
        future: Future[Answer] = Future()
        future.set_result(Answer(accepted=True))
        return future

    def events(self):
        return [event for event, _ in self.lines]

    def announced(self):
        return [fields["text"] for name, fields in self.asked if name == "announce"]


class Steady:
    """A clock that a test moves."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def bench(folder: Path, **options):
    options = {"start": "always", "frames": "png", "frames_hz": 0.0, "keep_free_mib": 0.0, **options}
    config = Config.model_validate({"recorder": options, "link": {"planner": "udpin:127.0.0.1:0"}})
    desk, clock = FakeDesk(), Steady()
    return Recorder(config, desk, folder=folder, monotonic_s=clock), desk, clock


def told(seq: int = 1) -> list[Message]:
    """One message of each kind, as the feed has them."""
    image = np.random.default_rng(seq).integers(0, 255, (48, 64), np.uint8)
    image.flags.writeable = False
    frame = {"number": 1, "seq": 7, "time_of": "exposure", "height_px": 48, "width_px": 64, "taken_ns": 1200}
    pose = {"north_m": 1 / 3, "east_m": -2.5, "down_m": -1.2, "q_ned_from_body": [0.8, 0.0, 0.0, 0.6]}
    return [
        Message(Kind.CONFIG, 1000, seq, {"active": {"log": {}}, "set": {}}),
        Message(Kind.LINK, 1001, seq + 1, {"link": "planner", "url": "udpin:1", "state": "open"}),
        Message(Kind.FRAME, 1100, seq + 2, frame, b"", image),
        Message(Kind.POSE, 1210, seq + 3, {**pose, "speed_m_s": 0.1}),
        Message(Kind.MAVLINK, 1220, seq + 4, {"link": 1, "direction": "in"}, HEARTBEAT * 2),
        Message(Kind.MAVLINK, 1225, seq + 5, {"link": 0, "direction": "in"}, HEARTBEAT),
        Message(Kind.DETECTION, 1230, seq + 6, {"frame_seq": 7, "kind": "none", "detector_s": 0.1}),
        Message(Kind.SETPOINT, 1240, seq + 7, {"planner": "255/190", "planned": [1.0, 2.0, 3.0]}),
        Message(Kind.STATE, 1250, seq + 8, {"previous": "a", "state": "b", "reason": "c"}),
        Message(Kind.LOOP, 1260, seq + 9, {"name": "health", "camera": None, "worker": "dead"}),
        Message(Kind.LOG, 1270, seq + 10, {"event": "odd", "level": "warning", "value": 3}),
        Message(Kind.STATUS, 1280, seq + 11, {"state": "b", "frames_hz": 30.0}),
    ]


def record(folder: Path, messages, **options):
    recorder, desk, _ = bench(folder, **options)
    recorder.start()
    for message in messages:
        recorder.take(message)
    recorder.stop()
    (path,) = folder.glob("*.mcap")
    return path, desk


def test_what_was_told_is_read_back(tmp_path):
    messages = told()
    path, desk = record(tmp_path, messages)
    file = RecordingFile(path)
    found = list(file.messages())
    assert file.damage is None
    assert file.about["begun_by"] == "always"
    assert [(m.kind, m.seq) for m in found] == [(m.kind, m.seq) for m in messages]
    for before, after in zip(messages, found, strict=True):
        assert (after.time_ns, after.data) == (before.time_ns, before.data)
        if before.kind is Kind.LOG:
            assert after.fields["fields"] == {"value": 3}
        elif before.kind is Kind.POSE:
            assert after.fields["pose"]["position"]["x"] == 1 / 3
        else:
            assert {key: after.fields[key] for key in before.fields} == before.fields
    np.testing.assert_array_equal(found[2].image, messages[2].image)
    assert desk.events() == ["recording_started", "recording_ended"]
    states = [fields["recording"] for name, fields in desk.asked if name == "recorder_state"]
    assert (states[0], states[-1]) == (True, False)


def test_the_official_reader_finds_index_schemas_and_pictures(tmp_path):
    path, _ = record(tmp_path, told(), frames="jpeg")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        schemas = {
            channel.topic: summary.schemas.get(channel.schema_id) for channel in summary.channels.values()
        }
        assert schemas["/camera/image"].name == "sensor_msgs/msg/CompressedImage"
        assert schemas["/camera/image"].encoding == "ros2msg"
        assert schemas["/pose"].name == "foxglove.PoseInFrame"
        assert schemas["/log"].name == "foxglove.Log"
        assert schemas["/mavlink/1/in"] is None
        for schema in filter(None, schemas.values()):
            if schema.encoding == "jsonschema":
                assert json.loads(schema.data)["type"] == "object"
        decoded = {channel.topic: message for _, channel, message in reader.iter_messages()}
    picture, format_name = topics.picture_of(decoded["/camera/image"].data)
    assert (picture[:2], picture[-2:], format_name) == (b"\xff\xd8", b"\xff\xd9", "jpeg")
    assert decoded["/camera/image"].data[:4] == b"\x00\x01\x00\x00"  # CDR, little endian
    assert abs(decoded["/state"].log_time / 1e9 - path.stat().st_mtime) < 3e9  # wall time, not ours


def test_the_tlog_is_the_autopilots_link_and_pymavlink_reads_it(tmp_path):
    frame = bytes(
        mavutil.mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(
            mavutil.mavlink.MAVLink(None, 1, 1)
        )
    )
    messages = [
        Message(Kind.MAVLINK, n * 10**9, n, {"link": n % 2, "direction": "in"}, frame * 2)
        for n in range(1, 9)
    ]
    record(tmp_path, messages)
    (path,) = tmp_path.glob("*.tlog")
    log = mavutil.mavlink_connection(str(path))
    times = []
    while (message := log.recv_match(type="HEARTBEAT")) is not None:
        times.append(message._timestamp)
    log.close()
    assert len(times) == 8  # two in each of four of the autopilot's link
    assert np.diff(times).round(3).tolist() == [0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0]


def test_a_file_cut_anywhere_is_read_up_to_there(tmp_path):
    messages = [message for n in range(60) for message in told(1 + 12 * n)]
    path, _ = record(tmp_path, messages)
    whole = path.read_bytes()
    all_of_it = [(m.kind, m.seq) for m in RecordingFile(path).messages()]
    cut = tmp_path / "cut.mcap"
    read = []
    for size in np.linspace(400, len(whole) - 1, 40).astype(int):
        cut.write_bytes(whole[:size])
        file = RecordingFile(cut)
        found = [(m.kind, m.seq) for m in file.messages(images=False)]
        assert file.damage is not None
        assert found == all_of_it[: len(found)]
        read.append(len(found))
    assert read == sorted(read)
    assert read[-1] == len(all_of_it)
    assert read[len(read) // 2] > len(all_of_it) // 4


def test_a_recording_that_was_never_finished_loses_little(tmp_path):
    recorder, _, _ = bench(tmp_path)
    recorder.start()
    for n in range(100):  # ten times a second
        for message in told(1 + 12 * n):
            recorder.take(replace(message, time_ns=message.time_ns + n * 10**8))
    (path,) = tmp_path.glob("*.mcap")  # as it is when we are killed: nothing waits in a buffer of ours
    found = list(RecordingFile(path).messages(images=False))
    recorder.stop()
    assert len(found) > 1200 - 12 * 12


def test_the_index_of_a_long_file_is_kept_packed(tmp_path):
    # The library would keep an object of a kilobyte for each chunk until the file ends: a tenth of the process an hour.
    file = GrowingFile(tmp_path / "long.mcap")
    mcap = McapFile(file, RecorderConfig(), 0, {}, ChunkLimits(size_bytes=1))
    count = 300
    for n in range(count):
        mcap.write(Message(Kind.STATUS, n * 10**6, n, {"state": "b"}))
        mcap.write(Message(Kind.MAVLINK, n * 10**6, n, {"link": 1, "direction": "in"}, HEARTBEAT))
    assert not [found for found in gc.get_objects() if isinstance(found, ChunkIndex)]
    mcap.finish()
    file.close()
    with file.path.open("rb") as opened:
        reader = make_reader(opened, validate_crcs=True)
        summary = reader.get_summary()
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 2 * count
        times_ns = [
            message.log_time for *_, message in reader.iter_messages(topics=["/status", "/mavlink/1/in"])
        ]
    assert times_ns == sorted(n * 10**6 for n in range(count) for _ in range(2))


def test_a_file_of_the_default_size_has_few_chunks(tmp_path):
    recorder, _, _ = bench(tmp_path, frames="jpeg", tlog=False)
    recorder.start()
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (240, 320), np.uint8)
    image.flags.writeable = False
    for n in range(100):  # ten seconds
        at_ns = n * 10**8
        size = {"number": n, "seq": n, "time_of": "exposure", "height_px": 240, "width_px": 320}
        recorder.take(Message(Kind.FRAME, at_ns, 2 * n, {**size, "taken_ns": at_ns}, b"", image))
        recorder.take(Message(Kind.STATUS, at_ns, 2 * n + 1, {"state": "b"}))
    recorder.stop()
    (path,) = tmp_path.glob("*.mcap")
    with path.open("rb") as opened:
        chunks = len(make_reader(opened).get_summary().chunk_indexes)
    most = path.stat().st_size / (64 * 1024) + 10 + 1  # by size, and one a second
    assert 10 <= chunks <= most


@pytest.mark.parametrize("content", [b"", b"nonsense" * 100])
def test_another_file_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="not a recording"):
        list(RecordingFile(path).messages())
    with pytest.raises(RecordingError, match="No such file"):
        list(RecordingFile(tmp_path / "none.mcap").messages())


def test_files_are_rotated_and_the_oldest_make_room(tmp_path):
    other = tmp_path / "mine.mcap"
    other.write_bytes(bytes(MIB))
    recorder, desk, clock = bench(tmp_path, file_mib=1.0, total_mib=3.0, tlog=False)
    recorder.start()
    rng = np.random.default_rng(3)
    for n in range(60):
        image = rng.integers(0, 255, (480, 640), np.uint8)
        fields = {
            "number": n,
            "seq": n,
            "time_of": "exposure",
            "height_px": 480,
            "width_px": 640,
            "taken_ns": n,
        }
        recorder.take(Message(Kind.FRAME, n, n + 1, fields, b"", image))
        recorder.take(Message(Kind.STATE, n, n + 2, {"previous": "a", "state": f"s{n}", "reason": ""}))
        clock.now_s += 1.1
    recorder.stop()
    files = sorted(tmp_path.glob("void-*.mcap"))
    assert "recording_goes_on" in desk.events()
    assert len(files) >= 2
    assert sum(file.stat().st_size for file in files) <= 3.6 * MIB  # with what one second more may write
    assert max(file.stat().st_size for file in files) <= 1.8 * MIB
    assert other.exists()
    last = list(RecordingFile(max(files, key=lambda file: file.stat().st_mtime_ns)).messages())
    assert last[0].kind is Kind.STATE  # what held when the file began


def test_arming_begins_and_disarming_ends_some_seconds_later(tmp_path):
    recorder, desk, clock = bench(tmp_path, start="armed", stop_after_s=5.0)
    recorder.start()
    assert desk.wants is None
    state = Message(Kind.STATE, 1, 1, {"previous": "", "state": "x", "reason": ""})
    recorder.take(state)
    assert not recorder.is_recording
    recorder.take(Message(Kind.CONTROL, 2, 2, {"name": "armed", "on": True}))
    assert recorder.is_recording
    assert Kind.FRAME in desk.wants.kinds
    recorder.take(Message(Kind.CONTROL, 3, 3, {"name": "armed", "on": False}))
    clock.now_s += 4.0
    recorder.idle()
    assert recorder.is_recording
    recorder.take(Message(Kind.CONTROL, 4, 4, {"name": "armed", "on": True}))  # at once in the air again
    clock.now_s += 10.0
    recorder.idle()
    assert recorder.is_recording
    recorder.take(Message(Kind.CONTROL, 5, 5, {"name": "armed", "on": False}))
    clock.now_s += 5.1
    recorder.idle()
    assert not recorder.is_recording
    assert desk.wants.kinds == frozenset()
    (path,) = tmp_path.glob("*.mcap")
    found = [m.kind for m in RecordingFile(path).messages()]
    assert found == [Kind.STATE, Kind.CONTROL, Kind.CONTROL, Kind.CONTROL, Kind.CONTROL]


def test_a_command_begins_and_ends(tmp_path):
    recorder, desk, _ = bench(tmp_path, start="command")
    recorder.start()
    recorder.take(Message(Kind.CONTROL, 1, 1, {"name": "armed", "on": True}))
    assert not recorder.is_recording
    recorder.take(Message(Kind.CONTROL, 1, 2, {"name": "record", "on": True}))
    recorder.take(Message(Kind.CONTROL, 1, 3, {"name": "record", "on": True}))
    assert recorder.is_recording
    recorder.take(Message(Kind.CONTROL, 1, 4, {"name": "record", "on": False}))
    assert not recorder.is_recording
    assert desk.events() == ["recording_started", "recording_ended"]


@pytest.mark.parametrize(
    ("folder", "options", "reason"),
    [
        ("/proc/void", {}, None),
        (None, {"keep_free_mib": 1048576.0}, "disk full"),
    ],
)
def test_where_nothing_can_be_written_recording_stops_with_one_announcement(
    tmp_path, folder, options, reason
):
    recorder, desk, clock = bench(Path(folder) if folder else tmp_path, **options)
    recorder.start()
    for message in told():
        recorder.take(message)
        clock.now_s += 2.0
        recorder.idle()
    assert not recorder.is_recording
    (announced,) = desk.announced()
    assert announced.startswith(f"recording stopped, {reason or ''}")
    assert desk.events() == ["recording_stopped"]
    recorder.stop()
    recorder.take(
        Message(Kind.CONTROL, 1, 2, {"name": "record", "on": True})
    )  # asked again, it says so again
    assert len(desk.announced()) == 2


def test_a_disk_that_becomes_full_ends_the_recording(tmp_path):
    recorder, desk, clock = bench(tmp_path)
    recorder.start()
    for message in told():
        recorder.take(message)
    # The real way to the disk, at a device that is full (ENOSPC).
    full = os.open("/dev/full", os.O_WRONLY)
    fd = recorder._recording._files[0]._fd
    os.dup2(full, fd)
    os.close(full)
    for n in range(40):
        for message in told(100 + 12 * n):
            recorder.take(replace(message, time_ns=message.time_ns + n * 10**8))
        clock.now_s += 0.1
    assert not recorder.is_recording
    assert desk.announced() == ["recording stopped, No space left on device"]
    recorder.stop()


def test_what_a_recorder_was_too_slow_for_is_in_the_recording(tmp_path):
    recorder, desk, clock = bench(tmp_path)
    recorder.start()
    recorder.take(told()[0])
    desk.dropped = {Kind.FRAME: 3}
    clock.now_s += 2.0
    recorder.take(told()[1])
    recorder.stop()
    (path,) = tmp_path.glob("*.mcap")
    (lost,) = [m.fields for m in RecordingFile(path).messages() if m.kind is Kind.CONTROL]
    assert (lost["name"], lost["by"], lost["counts"]) == ("dropped", "recorder", {"frame": 3})


def test_room_is_made_by_deleting_the_oldest_and_only_ours(tmp_path):
    for n in range(4):
        path = tmp_path / f"void-2026010{n + 1}T000000Z.mcap"
        path.write_bytes(bytes(MIB))
        os.utime(path, (1e9 + n, 1e9 + n))
    (tmp_path / "void-notes.txt").write_bytes(bytes(9 * MIB))
    (tmp_path / "void-20260109T000000Z.mcap").symlink_to("/etc/passwd")
    newest = tmp_path / "void-20260104T000000Z.mcap"
    assert make_room(tmp_path, Limits(MIB, 2 * MIB, 0), keep=frozenset()) is None
    assert [r.path.name for r in recordings(tmp_path)] == ["void-20260103T000000Z.mcap", newest.name]
    why = make_room(tmp_path, Limits(MIB, MIB // 2, 0), keep=frozenset({newest}))
    assert "recorder.total_mib" in why
    assert [r.path for r in recordings(tmp_path)] == [newest]
    assert (tmp_path / "void-20260109T000000Z.mcap").is_symlink()


def test_a_clock_that_goes_back_takes_no_name_twice(tmp_path):
    first = new_name(tmp_path, 10**18)
    first.with_name(first.name + ".tlog").touch()
    second = new_name(tmp_path, 10**18)
    assert second.name == f"{first.name}-2"


def test_the_folder_is_the_configured_one_or_systemds():
    config = Config()
    assert folder_of(config, {}) == Path("recordings")
    assert folder_of(config, {"LOGS_DIRECTORY": "/var/log/a:/var/log/b"}) == Path("/var/log/a/recordings")
    named = Config.model_validate({"recorder": {"folder": "/data"}})
    assert folder_of(named, {"LOGS_DIRECTORY": "/var/log/a"}) == Path("/data")


def test_a_file_larger_than_all_together_is_refused():
    with pytest.raises(ConfigError, match="file_mib"):
        parse_config("[recorder]\nfile_mib = 100.0\ntotal_mib = 50.0\n", name="x")


@pytest.mark.parametrize("format_name", ["jpeg", "png"])
@pytest.mark.parametrize("picture", [b"", b"1", b"12345678"])
def test_pictures_come_out_of_cdr_as_they_went_in(format_name, picture):
    assert topics.picture_of(topics.compressed_image(picture, format_name, 12 * 10**9 + 5)) == (
        picture,
        format_name,
    )
    with pytest.raises(ValueError, match="no compressed image"):
        topics.picture_of(io.BytesIO(topics.compressed_image(picture, format_name, 1)).read(13))
