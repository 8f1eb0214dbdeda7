import pytest

from companion.config import CameraConfig, DetectorConfig
from companion.guidance.observation import BearingRange, DetectionReport, Pose
from companion.vision.messages import (
    MAX_PACKET_BYTES,
    Answer,
    Detect,
    Failed,
    MapSlots,
    MessageError,
    Ready,
    Start,
    Unusable,
    pack_from_worker,
    pack_to_worker,
    unpack_from_worker,
    unpack_to_worker,
)

POSE = Pose(2**62, 0.1, -1e-9, 1 / 3, (1.0, 0.0, 0.0, 0.0))
REPORT = DetectionReport(
    7,
    2**62 + 1,
    "vanishing_point",
    x_px=0.1 + 0.2,
    ray_body=(1.0, 0.0, 1e-300),
    pose=POSE,
    bearings=tuple(BearingRange(i / 57.3, 3.3, 0.1, i) for i in range(60)),
)


@pytest.mark.parametrize(
    "message",
    [
        Start("a:b", DetectorConfig(threads=3), CameraConfig(hfov_deg=81.5)),
        MapSlots(1000, 2),
        Detect(1, 0, 480, 640, 9, 2**62, POSE),
        Detect(1, 0, 480, 640, 9, 2**62, None),
    ],
)
def test_messages_to_the_worker_arrive_as_they_were(message):
    assert unpack_to_worker(pack_to_worker(message)) == message


@pytest.mark.parametrize(
    "message", [Ready(), Unusable("ä"), Answer(3, REPORT), Failed("E: x", "Traceback\n  ...")]
)
def test_messages_from_the_worker_arrive_as_they_were(message):
    packet = pack_from_worker(message)
    assert unpack_from_worker(packet) == message
    assert len(packet) < MAX_PACKET_BYTES / 4


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        b"\x00",
        b"[]",
        b'{"kind": "detect"}',
        b'{"kind": "answer", "frame_id": 1}',
        b'{"kind": "answer", "frame_id": "x", "report": {}}',
        pack_from_worker(Answer(3, REPORT))[:-1],
        pack_from_worker(Answer(3, REPORT)).replace(b"3.3", b"null"),
    ],
)
def test_what_is_no_message_is_said_to_be_none(packet: bytes):
    with pytest.raises(MessageError):
        unpack_from_worker(packet)
