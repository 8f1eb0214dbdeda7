"""Replay: the same inputs lead to the same decisions, others to others, and what is missing is said."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.cli import main
from companion.config import Config
from companion.errors import CompanionError
from companion.guidance.observation import DetectionReport
from companion.io.messages import Answer, Kind, Message
from companion.mavlink import codec
from companion.mavlink.signing import Signatures
from companion.recorder.in_process import InProcessRecorder
from companion.recorder.reading import RecordingError, RecordingFile
from companion.recorder.sink import Recorder
from companion.replay.decisions import Decision, differences, sent_decisions
from companion.replay.detections import same_answer
from companion.replay.run import Difference, replay
from companion.sim.flight import FlightSpec
from companion.sim.lockstep_flight import fly_in_lockstep
from companion.sim.scene import empty_room
from tests.fakes.ray_cast_place import ray_cast_place

REFERENCES = Path(__file__).parents[2] / "data" / "recordings"
DECISIONS = REFERENCES / "decisions.mcap"
DETECTIONS = REFERENCES / "detections.mcap"
OTHER_PROCESSOR = 1e-3
"""Setpoints of the reference recordings were computed on another machine: sine and cosine differ in their last places."""


class Desk:
    """Nobody behind a recorder."""

    dropped: ClassVar[dict[Kind, int]] = {}
    log = property(lambda self: self)

    def info(self, event, **fields):
        pass

    warning = error = info

    def want(self, wants):
        pass

    def ask(self, name, fields):
        future: Future[Answer] = Future()
        future.set_result(Answer(accepted=True))
        return future


def rewritten(messages: Iterable[Message], folder: Path) -> Path:
    """Record messages as if the feed had told them."""
    folder.mkdir()
    config = Config.model_validate({"recorder": {"frames": "none", "tlog": False, "keep_free_mib": 0.0}})
    recorder = Recorder(config, Desk(), folder=folder, wall_offset_ns=10**18)
    recorder._begin("always")
    for message in messages:
        recorder.take(message)
    recorder.stop()
    (path,) = folder.glob("*.mcap")
    return path


def changed(change: Callable[[Message], Message | None]) -> Iterator[Message]:
    """Return the messages of the reference with some changed or left out."""
    for message in RecordingFile(DECISIONS).messages(images=False):
        other = change(message)
        if other is not None:
            yield other


def found_in(path: Path, **options) -> tuple[list[Difference], object]:
    found: list[Difference] = []
    summary = replay(RecordingFile(path), tolerance=OTHER_PROCESSOR, on_difference=found.append, **options)
    return found, summary


# ---------------------------------------------------------------------- the references


def test_the_reference_is_decided_as_it_was():
    """Where this fails, the switch S decides otherwise than it did: see CONTRIBUTING.md, "Reference recordings"."""
    found, summary = found_in(DECISIONS)
    assert [str(difference) for difference in found] == []
    assert summary.is_same
    assert summary.decisions["setpoint"] > 200
    assert summary.decisions["state"] >= 5
    assert summary.inputs[Kind.DETECTION] > 50
    assert summary.notes == []


def test_the_detector_answers_the_reference_as_it_did():
    """Where this fails, the published method answers otherwise: see CONTRIBUTING.md, "Reference recordings"."""
    found, summary = found_in(DETECTIONS, detections="rerun")
    assert [str(difference) for difference in found if difference.kind == "detection"] == []
    assert summary.decisions["detection"] >= 15
    assert summary.notes == []


# ---------------------------------------------------------------------- to the last bit


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    """A recorded flight of this machine and this code."""
    folder = tmp_path_factory.mktemp("flown")
    recorder = InProcessRecorder(folder)
    spec = FlightSpec(
        method="paper", width_px=128, height_px=96, frame_rate_hz=4.0, detection_s=0.1, time_limit_s=2.5
    )
    try:
        fly_in_lockstep(spec, ray_cast_place("hall", empty_room, 3.0), recorder)
    finally:
        recorder.close()
    (path,) = folder.glob("*.mcap")
    return path


def test_the_same_code_decides_and_sees_the_same_to_the_last_bit(flown, capsys):
    assert main(["replay", str(flown), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["same"] is True
    assert told["differences"] == {}
    assert told["notes"] == []
    assert told["decisions"]["setpoint"] > 50
    assert told["decisions"]["detection"] > 8


def test_other_settings_decide_otherwise_and_each_difference_is_said(flown, tmp_path, capsys):
    new = tmp_path / "new.toml"
    new.write_text("[camera]\nhfov_deg = 75.0\n[guidance]\nmax_step_m = 0.5\n[detector]\nmethod = 'paper'\n")
    assert main(["replay", str(flown), "--config", str(new), "--detections", "recorded"]) == 1
    lines = capsys.readouterr().out.splitlines()
    differing = [line for line in lines if " setpoint: recorded link 1: x " in line]
    assert len(differing) > 5
    assert "; now link 1: x " in differing[0]
    assert lines[-1].endswith("differ")


def test_another_camera_sees_otherwise(flown, tmp_path, capsys):
    new = tmp_path / "new.toml"
    new.write_text("[camera]\nhfov_deg = 110.0\n[detector]\nmethod = 'paper'\n")
    assert main(["replay", str(flown), "--config", str(new), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["differences"]["detection"] > 0


# ---------------------------------------------------------------------- what does not fit


def test_a_changed_decision_in_the_recording_is_found(tmp_path):
    """The comparison itself: one recorded setpoint is another one, by 2 cm."""
    count = [0]

    def nudge(message: Message) -> Message:
        if message.kind is Kind.MAVLINK and message.fields["direction"] == "out":
            decided = sent_decisions(1, message.data, 191)
            if decided and decided[0].setpoint is not None:
                count[0] += 1
                if count[0] == 100:
                    data = bytearray(message.data)
                    x_at = 10 + 4 if data[0] == 0xFD else 6 + 4
                    values = codec.unpack(_frame(message.data))
                    data[x_at : x_at + 4] = _f32(values.x + 0.02)
                    return replace(message, data=_with_checksum(bytes(data)))
        return message

    found, _ = found_in(rewritten(changed(nudge), tmp_path / "x"))
    assert [difference.kind for difference in found] == ["setpoint"]


def test_a_missing_input_is_not_the_same_flight(tmp_path):
    def without_detections(message: Message) -> Message | None:
        is_late = message.kind is Kind.DETECTION and message.fields["frame_seq"] > 30
        return None if is_late else message

    found, summary = found_in(rewritten(changed(without_detections), tmp_path / "x"))
    assert not summary.is_same
    assert {"state", "setpoint"} >= {difference.kind for difference in found} != set()


def test_what_was_lost_is_said(tmp_path):
    def with_loss(message: Message) -> Message:
        return message

    messages = list(changed(with_loss))
    lost = {"name": "dropped", "by": "feed", "counts": {"mavlink": 7, "status": 99}}
    messages.insert(500, Message(Kind.CONTROL, messages[500].time_ns, 1, lost))
    _, summary = found_in(rewritten(messages, tmp_path / "x"))
    assert len(summary.notes) == 1
    assert "feed had lost 7 mavlink by" in summary.notes[0]


def test_a_recording_that_begins_in_flight_is_compared_once_it_has_caught_up(tmp_path):
    messages = list(changed(lambda message: message))
    config = next(message for message in messages if message.kind is Kind.CONFIG)
    late = [config, *(message for message in messages if message.time_ns > config.time_ns + 5 * 10**9)]
    path = rewritten(late, tmp_path / "x")
    file = RecordingFile(path)
    list(file.messages(images=False))
    assert file.about["begun_by"] == "always"
    data = path.read_bytes()
    armed = tmp_path / "armed.mcap"
    armed.write_bytes(data.replace(b"always", b"armed!"))  # same length; metadata has no checksum of its own
    _, summary = found_in(armed)
    assert any("begins in flight" in note for note in summary.notes)
    assert summary.before_caught_up > 0
    assert summary.differences.total() < summary.decisions.total() // 4


def test_a_cut_file_is_replayed_up_to_its_end(tmp_path, flown):
    cut = tmp_path / "cut.mcap"
    whole = flown.read_bytes()
    cut.write_bytes(whole[: 2 * len(whole) // 3])
    summary = replay(RecordingFile(cut))
    assert summary.is_same
    assert any("cut off" in note for note in summary.notes)


def test_lossy_frames_are_said(tmp_path, flown):
    file = RecordingFile(flown)
    messages = [
        replace(message, fields={**message.fields, "lossless": False})
        if message.kind is Kind.FRAME
        else message
        for message in file.messages()
    ]
    summary = replay(_Given(flown, file.about, messages), detections="rerun")
    assert summary.is_same
    assert any("as JPEG" in note for note in summary.notes)
    without = [message for message in messages if message.kind is not Kind.FRAME]
    summary = replay(_Given(flown, file.about, without), detections="rerun")
    assert summary.is_same  # by the recorded answers
    assert any("not recorded" in note for note in summary.notes)


class _Given(RecordingFile):
    """Messages as they would be read."""

    def __init__(self, path: Path, about: dict[str, str], messages: list[Message]) -> None:
        super().__init__(path)
        self.about = about
        self._given = messages

    def messages(self, *, images: bool = True) -> Iterator[Message]:
        yield from self._given


@pytest.mark.parametrize("name", ["none.mcap", "other.mcap", "empty.mcap"])
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, name, capsys):
    (tmp_path / "other.mcap").write_bytes(b"nothing of the kind" * 99)
    (tmp_path / "empty.mcap").touch()
    assert main(["replay", str(tmp_path / name)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1


def test_a_recording_without_inputs_cannot_be_replayed(tmp_path):
    path = rewritten(
        [Message(Kind.STATE, 1, 1, {"previous": "", "state": "x", "reason": ""})], tmp_path / "x"
    )
    with pytest.raises(CompanionError, match="nothing that could be replayed"):
        replay(RecordingFile(path))
    with pytest.raises(RecordingError):
        replay(RecordingFile(tmp_path / "none"))


# ---------------------------------------------------------------------- the comparison


def decision(kind="setpoint", key=("a",), text="t") -> Decision:
    return Decision(kind, key, text)


def test_lists_of_decisions_are_compared_kind_by_kind():
    one, two = decision(key=("a",)), decision(key=("b",))
    state = decision(kind="state", key=("s",))
    assert differences([one, state], [one, state], 0.0) == []
    assert differences([one, state], [state, one], 0.0) == []  # order between kinds is the wire's
    assert differences([one], [two], 0.0) == [(one, two)]
    assert differences([one, state], [one], 0.0) == [(state, None)]
    assert differences([], [one], 0.0) == [(None, one)]


def test_answers_are_compared_exactly_or_with_tolerance():
    report = DetectionReport(1, 2, "gap", x_px=10.0, y_px=20.0, distance_m=3.0)
    assert same_answer(report, report, tolerant=False)
    near = replace(report, x_px=11.0, distance_m=3.1)
    assert not same_answer(report, near, tolerant=False)
    assert same_answer(report, near, tolerant=True)
    assert not same_answer(report, replace(report, x_px=20.0), tolerant=True)
    assert not same_answer(report, replace(report, distance_m=None), tolerant=True)
    assert not same_answer(report, replace(report, kind="none", reason="blurred"), tolerant=True)


def test_a_signature_is_no_decision_and_neither_is_a_number_of_our_own():
    """Signatures hold the time of day; our sequence numbers count everything that we say."""
    planner = mavlink.MAVLink(None, srcSystem=245, srcComponent=190)
    setpoint = mavlink.MAVLink_set_position_target_local_ned_message(
        1, 1, 1, 1, 3576, 5.0, 0.0, -1.2, 0, 0, 0, 0, 0, 0, 0, 0
    )
    data = bytes(setpoint.pack(planner))
    early, late = (
        Signatures(bytes(range(32)), link_id=1, unix_ns=lambda at=at: at * 10**18).sign(data) for at in (2, 3)
    )
    assert early != late
    assert sent_decisions(1, early, 191) == sent_decisions(1, late, 191) != []
    ours = [mavlink.MAVLink(None, srcSystem=1, srcComponent=191) for _ in range(2)]
    ours[1].seq = 99
    one, two = (bytes(setpoint.pack(sender)) for sender in ours)
    assert one != two
    assert sent_decisions(1, one, 191) == sent_decisions(1, two, 191)
    other = mavlink.MAVLink_set_position_target_local_ned_message(
        1, 1, 1, 1, 3576, 5.1, 0.0, -1.2, 0, 0, 0, 0, 0, 0, 0, 0
    )
    assert sent_decisions(1, one, 191) != sent_decisions(1, bytes(other.pack(ours[0])), 191)


def _frame(data: bytes):
    from companion.mavlink.framing import Framer

    return Framer().feed(data)[0]


def _f32(value: float) -> bytes:
    import struct

    return struct.pack("<f", value)


def _with_checksum(data: bytes) -> bytes:
    from companion.mavlink.framing import checksum

    frame_id = int.from_bytes(data[7:10], "little") if data[0] == 0xFD else data[5]
    end = len(data) - 2
    return data[:end] + checksum(data[1:end], frame_id).to_bytes(2, "little")


def test_references_are_small():
    assert sum(path.stat().st_size for path in REFERENCES.glob("*")) < 1_000_000
