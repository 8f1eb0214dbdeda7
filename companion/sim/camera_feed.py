"""A live camera on a simulated vehicle: rendered in a process of its own, sent over TCP.

Rendering would hold up the telemetry of an autopilot in the same process. So the poses cross by a socket pair,
without waiting, and the child renders the newest one.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import multiprocessing
import signal
import socket
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from companion.clock import Clock, RealClock
from companion.errors import CompanionError, LinkError, SourceError
from companion.guidance.coordinates import r_body_from_camera, r_ned_from_body
from companion.guidance.observation import Pose
from companion.sim.frame_faults import FrameFaults
from companion.sim.frame_server import Address, FrameServer

if TYPE_CHECKING:
    from detector.camera_model import CameraModel

_POSE = struct.Struct("<q7d")
_READY = b"ready "
_FAILED = b"failed "
_NO_SCENE = b"no-scene "
_LONGEST_MESSAGE = 4096
_STOP_S = 3.0


class Renderer(Protocol):
    """A world that can be looked at, such as ``companion.sim.scene.Scene``."""

    def render(
        self, camera: CameraModel, position_ned_m: ArrayLike, r_ned_from_camera: ArrayLike, /
    ) -> NDArray[np.uint8]:
        """Return the (height, width) grey image seen from a position with an attitude."""
        ...


@dataclass(frozen=True, slots=True)
class CameraMount:
    """How the camera sits on the body, rad; with all angles 0 it looks forward, its image upright."""

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0


def render_at(
    scene: Renderer, camera: CameraModel, pose: Pose, mount: CameraMount | None = None
) -> NDArray[np.uint8]:
    """Return what the camera of a vehicle sees.

    Parameters
    ----------
    scene
        The world.
    camera
        Size and lens.
    pose
        Of the vehicle's body.
    mount
        How the camera sits on it; by default it looks forward.

    Returns
    -------
    (height, width) uint8, grey.
    """
    mount = mount if mount is not None else CameraMount()
    body_from_camera = r_body_from_camera(mount.roll_rad, mount.pitch_rad, mount.yaw_rad)
    position = (pose.north_m, pose.east_m, pose.down_m)
    return scene.render(camera, position, r_ned_from_body(pose.q_ned_from_body) @ body_from_camera)


class CameraFeed:
    """Renders what a vehicle sees and serves it as frames; ``async with`` is its lifetime.

    Parameters
    ----------
    scene
        Makes the world, in the child process: a function at module level, or a ``functools.partial`` of one.
    camera
        Size and lens.
    pose
        Gives the vehicle's true pose now, for example ``FakeAutopilot.true_pose``.
    listen
        TCP address of the frame server; port 0 lets the system choose, see ``address``.
    rate_hz
        Frames a second at most; where rendering is slower, the newest pose is rendered.
    mount
        How the camera sits on the body.
    faults
        Frames that are lost or late.
    clock
        Where time comes from.
    start_timeout_s
        How long the child process may take to make the scene.

    Raises
    ------
    companion.errors.LinkError
        On entering, when the address cannot be had.
    companion.errors.SourceError
        On entering, when the child process does not come up or cannot make the scene.
    """

    def __init__(
        self,
        scene: Callable[[], Renderer],
        camera: CameraModel,
        pose: Callable[[], Pose],
        *,
        listen: Address = ("127.0.0.1", 0),
        rate_hz: float = 10.0,
        mount: CameraMount | None = None,
        faults: FrameFaults | None = None,
        clock: Clock | None = None,
        start_timeout_s: float = 30.0,
    ) -> None:
        if not 0.0 < rate_hz <= 240.0:
            raise ValueError(f"rate_hz must be above 0 and at most 240, got {rate_hz}")
        self._scene = scene
        self._camera = camera
        self._pose = pose
        self._listen = listen
        self._period_ns = round(1e9 / rate_hz)
        self._mount = mount if mount is not None else CameraMount()
        self._faults = faults if faults is not None else FrameFaults()
        self._clock: Clock = clock if clock is not None else RealClock()
        self._start_timeout_s = start_timeout_s
        self._process: BaseProcess | None = None
        self._socket: socket.socket | None = None
        self._task: asyncio.Task[None] | None = None
        self._address: Address | None = None
        self.poses_sent = 0
        self.poses_dropped = 0

    async def __aenter__(self) -> Self:
        # SOCK_SEQPACKET keeps messages apart, and its end of file tells the child that we are gone.
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        self._socket = ours
        try:
            context = multiprocessing.get_context("spawn")
            self._process = context.Process(
                target=_run_child,
                args=(theirs, self._listen, self._scene, self._camera, self._mount, self._faults),
                name="camera",
                daemon=True,
            )
            try:
                await asyncio.to_thread(self._process.start)
            finally:
                theirs.close()
            self._address = await self._wait_ready(ours)
        except BaseException:
            await self._stop()
            raise
        self._task = asyncio.get_running_loop().create_task(self._send_poses(ours), name="camera poses")
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait({self._task})
        await self._stop()
        if self._task is not None and not self._task.cancelled():
            self._task.result()  # raises what went wrong, for example in ``pose``

    @property
    def address(self) -> Address:
        """The TCP address that serves the frames."""
        if self._address is None:
            raise RuntimeError("the camera has not been entered: use 'async with'")
        return self._address

    @property
    def alive(self) -> bool:
        """Whether the child process runs."""
        return self._process is not None and self._process.is_alive()

    async def _wait_ready(self, ours: socket.socket) -> Address:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(self._start_timeout_s):
                message = await loop.sock_recv(ours, _LONGEST_MESSAGE)
        except TimeoutError as error:
            raise SourceError(
                f"the camera process was not ready within {self._start_timeout_s:g} s"
            ) from error
        if message.startswith(_READY):
            host, port = message[len(_READY) :].decode().rsplit(":", 1)
            return host, int(port)
        if message.startswith(_FAILED):
            raise LinkError(message[len(_FAILED) :].decode())
        if message.startswith(_NO_SCENE):
            raise SourceError(message[len(_NO_SCENE) :].decode())
        raise SourceError("the camera process ended before it was ready; its traceback is above")

    async def _send_poses(self, ours: socket.socket) -> None:
        due_ns = self._clock.now_ns()
        while True:
            pose = self._pose()
            message = _POSE.pack(pose.time_ns, pose.north_m, pose.east_m, pose.down_m, *pose.q_ned_from_body)
            try:
                ours.send(message)
                self.poses_sent += 1
            except BlockingIOError:
                self.poses_dropped += 1  # the child is busy: it has newer poses than it can use
            except OSError:
                return  # the child is gone; ``alive`` says so
            due_ns = max(due_ns + self._period_ns, self._clock.now_ns())
            await self._clock.sleep_until_ns(due_ns)

    async def _stop(self) -> None:
        if self._socket is not None:
            self._socket.close()
        process = self._process
        if process is None or process.pid is None:
            return
        await asyncio.to_thread(process.join, _STOP_S)
        if process.is_alive():
            process.kill()
            await asyncio.to_thread(process.join)
        self._process = None
        process.close()


def _run_child(
    poses: socket.socket,
    listen: Address,
    scene: Callable[[], Renderer],
    camera: CameraModel,
    mount: CameraMount,
    faults: FrameFaults,
) -> None:
    # Ctrl-C reaches the whole process group; the parent decides when this one ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    poses.setblocking(False)
    with poses, contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the parent is gone
        asyncio.run(_serve(poses, listen, scene, camera, mount, faults))


async def _serve(
    poses: socket.socket,
    listen: Address,
    make_scene: Callable[[], Renderer],
    camera: CameraModel,
    mount: CameraMount,
    faults: FrameFaults,
) -> None:
    loop = asyncio.get_running_loop()
    try:
        # One thread makes the scene and renders it: a graphics context belongs to the thread that made it.
        with ThreadPoolExecutor(1, "renderer") as thread:
            scene = await loop.run_in_executor(thread, make_scene)
            render = partial(render_at, scene, camera, mount=mount)
            await _serve_frames(poses, listen, render, thread, faults)
    except CompanionError as error:
        kind = _FAILED if isinstance(error, LinkError) else _NO_SCENE
        await loop.sock_sendall(poses, kind + str(error).encode()[: _LONGEST_MESSAGE - len(kind)])


async def _serve_frames(
    poses: socket.socket,
    listen: Address,
    render: Callable[[Pose], NDArray[np.uint8]],
    thread: ThreadPoolExecutor,
    faults: FrameFaults,
) -> None:
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    async with FrameServer(listen) as server:
        host, port = server.address
        await loop.sock_sendall(poses, _READY + f"{host}:{port}".encode())
        for number in itertools.count():
            message = await _newest(poses)
            if not message:
                break
            received_s, delay_ns = loop.time(), faults.delay_ns(number)
            if delay_ns is None:
                continue
            time_ns, north_m, east_m, down_m, *q = _POSE.unpack(message)
            pose = Pose(time_ns, north_m, east_m, down_m, (q[0], q[1], q[2], q[3]))
            image = await loop.run_in_executor(thread, render, pose)
            due_s = max(due_s, received_s + delay_ns / 1e9)  # jitter does not put frames out of order
            loop.call_at(due_s, server.publish, image, time_ns)


async def _newest(poses: socket.socket) -> bytes:
    """Return the newest message that has come, waiting for one where there is none; empty at the end of file."""
    message = await asyncio.get_running_loop().sock_recv(poses, _LONGEST_MESSAGE)
    with contextlib.suppress(BlockingIOError):
        while message:
            message = poses.recv(_LONGEST_MESSAGE)
    return message
