"""What the detector saw on the way, handed out where somebody looks, by both methods."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time

import numpy as np
import pytest
import structlog

from companion.clock import RealClock
from companion.config import CameraConfig, DetectorConfig
from companion.frames.source import Frame
from companion.guidance.coordinates import quaternion_from_euler, r_body_from_camera, r_ned_from_body
from companion.guidance.observation import Pose
from companion.io.messages import MAX_PACKET_BYTES, pack_arrays, unpack_arrays
from companion.sim.scene import corridor
from companion.vision.child import build_pipeline
from companion.vision.messages import Details, MessageError, pack_from_worker, unpack_from_worker
from companion.vision.pipeline import WithDetails
from companion.vision.supervisor import VisionSupervisor
from detector.camera_model import CameraModel

CAMERA = CameraModel.from_hfov(640, 480, 70.0)
LEVEL = quaternion_from_euler(0.0, 0.0, 0.0)


def flown(steps: int) -> list[tuple[Frame, Pose]]:
    looking = r_ned_from_body(LEVEL) @ r_body_from_camera(0.0, 0.0, 0.0)
    frames = []
    for index in range(steps):
        time_ns = 1_000_000_000 + index * 200_000_000
        image = corridor().render(CAMERA, (index * 0.2, 0.0, -1.3), looking)
        frames.append((Frame(image, time_ns, index), Pose(time_ns, index * 0.2, 0.0, -1.3, LEVEL)))
    return frames


@pytest.fixture(scope="module")
def frames() -> list[tuple[Frame, Pose]]:
    return flown(3)


@pytest.mark.parametrize("method", ["paper", "parallax"])
def test_both_methods_tell_what_they_saw(method, frames):
    pipeline = build_pipeline(DetectorConfig(method=method), CameraConfig(hfov_deg=70.0))
    assert isinstance(pipeline, WithDetails)
    assert pipeline.details() == ({}, {})
    for frame, pose in frames:
        report = pipeline.detect(frame, pose)
    fields, arrays = pipeline.details()
    assert fields["method"] == method
    layout, data = pack_arrays(arrays)
    assert len(data) + len(json.dumps(fields, default=str)) < MAX_PACKET_BYTES - 4096
    again = unpack_arrays(layout, data)
    assert fields["focus_px"] == pytest.approx((319.5, 239.5), abs=25)
    if method == "paper":
        flow, passed = again["flow"], again["flow_filter"]
        assert len(flow) == len(passed) > 50
        assert {0, 1, 2} >= set(passed.tolist()) >= {0, 2}
        lengths = np.hypot(flow[:, 2] - flow[:, 0], flow[:, 3] - flow[:, 1])
        assert lengths[passed == 0].max() <= lengths[passed > 0].min() + 1e-3  # the shortest went first
        assert len(again["features"]) >= len(flow)
        assert report.kind == "none" or len(again["centres"]) >= 2
        assert fields["counts"]["n_after_distribution"] >= len(flow)
    else:
        samples, told = again["samples"], again["informative"].astype(bool)
        assert len(samples) == len(told) > 50
        # A wall is 1.2 m to the side at the most; straight ahead it is far.
        assert np.median(samples[told, 2]) > 0.1
        void_map = again["void_map"]
        known = void_map[:, 1] >= 0
        assert void_map.shape == (360, 3)
        assert known.any()
        assert not known.all()
        ahead = void_map[known][np.argmin(np.abs(void_map[known, 0]))]
        aside = void_map[known][np.argmax(np.abs(void_map[known, 0]))]
        assert ahead[1] > aside[1]


@pytest.mark.parametrize("message", [Details(b'{"a": 1}', b"\x00\xff"), Details(b"", b"")])
def test_details_cross_as_they_are(message):
    assert unpack_from_worker(pack_from_worker(message)) == message


@pytest.mark.parametrize("cut", [1, 4, 8])
def test_details_cut_short_are_refused(cut):
    with pytest.raises(MessageError, match="short"):
        unpack_from_worker(pack_from_worker(Details(b'{"a": 1}', b""))[:cut])


async def test_the_worker_hands_them_out_while_somebody_looks(frames):
    looks, told, reports = [False], [], []
    supervisor = VisionSupervisor(
        DetectorConfig(method="paper"),
        CameraConfig(hfov_deg=70.0),
        clock=RealClock(),
        on_report=reports.append,
        log=structlog.wrap_logger(None, processors=[_drop]).bind(),
        on_details=told.append,
        wants_details=lambda: looks[0],
    )
    running = asyncio.create_task(supervisor.run())
    await asyncio.wait_for(supervisor.wait_ready(), 60)

    async def offer(index: int) -> None:
        supervisor.offer(*frames[index])
        end_s = time.monotonic() + 60
        while len(reports) < index + 1:
            assert time.monotonic() < end_s
            await asyncio.sleep(0.01)

    await offer(0)
    looks[0] = True
    await offer(1)
    await offer(2)
    end_s = time.monotonic() + 60
    while len(told) < 2:
        assert time.monotonic() < end_s
        await asyncio.sleep(0.01)
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running
    fields = [json.loads(details.fields) for details in told]
    assert [field["frame_seq"] for field in fields] == [1, 2]  # nobody looked at the first
    assert unpack_arrays(fields[1]["arrays"], told[1].data)["flow"].shape[1] == 4
    assert math.isclose(sum(fields[1]["seconds"].values()), reports[2].detector_s, rel_tol=0.9)


def _drop(logger, method, event):
    raise structlog.DropEvent
