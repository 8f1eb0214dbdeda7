from __future__ import annotations

import asyncio
import functools
import os
import socket
import struct
import threading
import time

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from companion.errors import CompanionError, LinkError, SourceError
from companion.frames.socket import frame_bytes
from companion.guidance.coordinates import quaternion_from_euler
from companion.guidance.observation import Pose
from companion.sim.camera_feed import CameraFeed, CameraMount
from companion.sim.frame_server import FrameServer
from companion.sim.scene import empty_room
from detector.camera_model import CameraModel

CAMERA = CameraModel.from_hfov(160, 120, 70.0)


async def read_frame(reader: asyncio.StreamReader) -> tuple[NDArray[np.uint8], int, int]:
    magic, width, height, seq, time_ns, reserved, payload = struct.unpack(
        "<4sHHIQQI", await reader.readexactly(32)
    )
    assert (magic, reserved, payload) == (b"VCF1", 0, width * height)
    pixels = np.frombuffer(await reader.readexactly(payload), np.uint8)
    return pixels.reshape(height, width), seq, time_ns


def test_a_frame_on_the_wire_is_header_and_rows() -> None:
    image = np.arange(6, dtype=np.uint8).reshape(2, 3)
    data = frame_bytes(image, seq=7, time_ns=123456789)
    assert data[:4] == b"VCF1"
    assert struct.unpack("<HHIQQI", data[4:32]) == (3, 2, 7, 123456789, 0, 6)
    assert data[32:] == bytes(range(6))
    sliced = np.arange(24, dtype=np.uint8).reshape(4, 6)[::2, ::2]
    assert frame_bytes(sliced, seq=0, time_ns=0)[32:] == sliced.tobytes()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((2, 2, 3), np.uint8),
        np.zeros((2, 2)),
        np.zeros((0, 4), np.uint8),
        np.zeros((1, 70000), np.uint8),
    ],
)
def test_only_grey_images_of_a_sensible_size_are_frames(image: NDArray[np.uint8]) -> None:
    with pytest.raises(ValueError, match="expected"):
        frame_bytes(image, seq=0, time_ns=0)


async def test_two_readers_get_the_frames_from_when_they_came() -> None:
    async with FrameServer() as server:
        server.publish(np.full((4, 6), 1, np.uint8), 10)
        first, first_writer = await asyncio.open_connection(*server.address)
        second, second_writer = await asyncio.open_connection(*server.address)
        while server.clients < 2:  # noqa: ASYNC110 - the server has no event for it
            await asyncio.sleep(0.005)
        await asyncio.sleep(0.02)
        server.publish(np.full((4, 6), 2, np.uint8), 20)
        for reader in (first, second):
            image, seq, time_ns = await read_frame(reader)
            assert (image == 2).all()
            assert (seq, time_ns) == (1, 20)
        first_writer.close()
        while server.clients > 1:  # noqa: ASYNC110
            await asyncio.sleep(0.005)
        server.publish(np.full((4, 6), 3, np.uint8), 30)
        assert (await read_frame(second))[1] == 2
        second_writer.close()


async def test_a_slow_reader_misses_frames_and_gets_the_newest() -> None:
    async with FrameServer() as server:
        sock = socket.socket()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, server.address)
        reader, writer = await asyncio.open_connection(sock=sock, limit=8192)
        while not server.clients:  # noqa: ASYNC110
            await asyncio.sleep(0.005)
        for number in range(50):
            server.publish(np.full((240, 320), number, np.uint8), number)
            await asyncio.sleep(0.002)
        numbers = []
        while not numbers or numbers[-1] < 49:
            image, seq, time_ns = await read_frame(reader)
            assert (image == seq).all()
            assert time_ns == seq
            numbers.append(seq)
        assert numbers == sorted(set(numbers))
        assert len(numbers) < 25
        writer.close()


async def test_a_camera_process_shows_the_scene_from_the_poses() -> None:
    room = functools.partial(empty_room, seed=3)
    yaw_rad = 0.4
    taken: list[Pose] = []

    def pose() -> Pose:
        attitude = quaternion_from_euler(0.05, -0.1, yaw_rad)
        taken.append(Pose(time.monotonic_ns(), 0.1 * len(taken), 0.5, -1.2, attitude))
        return taken[-1]

    async with CameraFeed(room, CAMERA, pose, rate_hz=20.0, mount=CameraMount(pitch_rad=0.1)) as feed:
        assert feed.alive
        reader, writer = await asyncio.open_connection(*feed.address)
        async with asyncio.timeout(20):
            frames = [await read_frame(reader) for _ in range(3)]
        process = feed._process
        assert process is not None
        pid = process.pid
        writer.close()
    assert pid is not None
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)

    by_time = {pose.time_ns: pose for pose in taken}
    scene = room()
    forward = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    cos, sin = np.cos, np.sin

    def about(axis: int, angle: float) -> NDArray[np.float64]:
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        r = np.eye(3)
        r[[i, j], [i, j]] = cos(angle)
        r[i, j], r[j, i] = -sin(angle), sin(angle)
        return r

    attitude = about(2, yaw_rad) @ about(1, -0.1) @ about(0, 0.05) @ about(1, 0.1) @ forward
    for image, _, time_ns in frames:
        at = by_time[time_ns]
        expected = scene.render(CAMERA, (at.north_m, at.east_m, at.down_m), attitude)
        assert expected.std() > 5.0
        assert np.abs(image.astype(int) - expected.astype(int)).mean() < 1.0


async def test_what_goes_wrong_in_the_pose_comes_out() -> None:
    def pose() -> Pose:
        raise RuntimeError("no vehicle")

    with pytest.raises(RuntimeError, match="no vehicle"):
        async with CameraFeed(empty_room, CAMERA, pose):
            await asyncio.sleep(0.1)


class _Broken:
    def render(
        self, camera: CameraModel, position_ned_m: ArrayLike, r_ned_from_camera: ArrayLike, /
    ) -> NDArray[np.uint8]:
        raise AssertionError("never reached")


def no_scene() -> _Broken:
    raise SystemExit("this scene cannot be made")


async def test_a_scene_that_cannot_be_made_is_a_clear_error() -> None:
    with pytest.raises(SourceError, match="ended before it was ready"):
        async with CameraFeed(no_scene, CAMERA, lambda: Pose(0, 0, 0, 0, (1, 0, 0, 0))):
            pass


def unusable_scene() -> _Broken:
    raise CompanionError("this world has no floor")


async def test_a_scene_that_says_why_it_cannot_be_made_is_that_error() -> None:
    with pytest.raises(SourceError, match="this world has no floor"):
        async with CameraFeed(unusable_scene, CAMERA, lambda: Pose(0, 0, 0, 0, (1, 0, 0, 0))):
            pass


class OneThread:
    """Answers with a picture of whether it is used by the thread that made it, and by no other."""

    def __init__(self) -> None:
        self.thread = threading.get_ident()

    def render(self, camera: CameraModel, position: ArrayLike, r: ArrayLike, /) -> NDArray[np.uint8]:
        return np.full(
            (camera.height_px, camera.width_px), 200 * (threading.get_ident() == self.thread), np.uint8
        )


async def test_a_scene_is_rendered_by_the_thread_that_made_it() -> None:
    async with CameraFeed(
        OneThread, CAMERA, lambda: Pose(time.monotonic_ns(), 0, 0, 0, (1, 0, 0, 0)), rate_hz=50
    ) as feed:
        reader, writer = await asyncio.open_connection(*feed.address)
        for _ in range(5):
            assert (await read_frame(reader))[0].min() == 200
        writer.close()
        await writer.wait_closed()


async def test_a_port_in_use_is_a_clear_error() -> None:
    async with FrameServer() as server:
        with pytest.raises(LinkError, match=f"tcp 127.0.0.1:{server.address[1]}"):
            async with FrameServer(server.address):
                pass
        with pytest.raises(LinkError, match=f"tcp 127.0.0.1:{server.address[1]}"):
            async with CameraFeed(
                _Broken, CAMERA, lambda: Pose(0, 0, 0, 0, (1, 0, 0, 0)), listen=server.address
            ):
                pass
