"""Simulated time: steps only when nothing is left to do, waits for answers, and fails where they do not come."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import threading
import time

import pytest

from companion.clock import RealClock
from companion.sim.lockstep import LockstepError, LockstepLoop, run_lockstep

SEC = 1_000_000_000


def started_python(program: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)


def test_an_hour_of_sleeping_takes_no_time_and_wakes_in_order_to_the_nanosecond():
    woken: list[tuple[str, int]] = []

    async def main(loop: LockstepLoop) -> None:
        clock = loop.clock
        start_ns = clock.now_ns()

        async def sleeper(name: str, delay_ns: int) -> None:
            await clock.sleep_until_ns(start_ns + delay_ns)
            woken.append((name, clock.now_ns() - start_ns))

        await asyncio.gather(
            sleeper("hour", 3600 * SEC), sleeper("odd", 333_333_333), sleeper("nanosecond", 1)
        )

    began = time.monotonic()
    run_lockstep(main)
    assert woken == [("nanosecond", 1), ("odd", 333_333_333), ("hour", 3600 * SEC)]
    assert time.monotonic() - began < 60


def test_asyncio_s_own_timers_are_simulated_too():
    async def main(loop: LockstepLoop) -> tuple[float, float]:
        began = loop.time()
        await asyncio.sleep(100)
        slept = loop.time() - began
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(50):
                await loop.create_future()
        return slept, loop.time() - began

    assert run_lockstep(main) == pytest.approx((100, 150))


def test_a_datagram_is_read_before_time_goes_on():
    async def main(loop: LockstepLoop) -> list[tuple[bytes, int]]:
        clock = loop.clock
        received: list[tuple[bytes, int]] = []

        class Receiver(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, addr: object) -> None:
                received.append((data, clock.now_ns()))

        inbox, _ = await loop.create_datagram_endpoint(Receiver, local_addr=("127.0.0.1", 0))
        outbox, _ = await loop.create_datagram_endpoint(
            asyncio.DatagramProtocol, remote_addr=inbox.get_extra_info("sockname")
        )
        start_ns = clock.now_ns()
        for number in range(3):
            outbox.sendto(bytes([number]))
            await clock.sleep_until_ns(start_ns + (number + 1) * 1000)
        inbox.close()
        outbox.close()
        await asyncio.sleep(0)
        return [(data, at_ns - start_ns) for data, at_ns in received]

    assert run_lockstep(main) == [(b"\0", 0), (b"\1", 1000), (b"\2", 2000)]


def test_time_waits_for_a_datagram_that_is_on_its_way():
    async def main(loop: LockstepLoop) -> int:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        on_the_way = 1
        read_ns = -1

        def read() -> None:
            nonlocal on_the_way, read_ns
            ours.recv(10)
            on_the_way, read_ns = 0, loop.clock.now_ns()

        with ours, theirs:
            loop.add_reader(ours.fileno(), read)
            loop.count_datagrams(lambda: on_the_way)
            start_ns = loop.clock.now_ns()
            late = threading.Timer(0.2, theirs.send, [b"x"])
            late.start()
            await loop.clock.sleep_until_ns(start_ns + SEC)
            late.join()
            loop.remove_reader(ours.fileno())
        return read_ns - start_ns

    assert run_lockstep(main) == 0


@pytest.mark.parametrize("really_s", [0.0, 0.3])
def test_an_answer_is_read_when_the_work_is_said_to_be_done_however_long_it_takes(really_s: float):
    async def main(loop: LockstepLoop) -> tuple[int, int]:
        ours, theirs = socket.socketpair()
        ticks = 0
        answered: asyncio.Future[int] = loop.create_future()

        def read() -> None:
            ours.recv(10)
            answered.set_result(loop.clock.now_ns())

        async def tick() -> None:
            nonlocal ticks
            while True:
                ticks += 1
                await loop.clock.sleep_until_ns(loop.clock.now_ns() + 10_000_000)

        with ours, theirs:
            loop.add_reader(ours.fileno(), read)
            start_ns = loop.clock.now_ns()
            ticking = asyncio.create_task(tick())
            worker = threading.Timer(really_s, theirs.send, [b"x"])
            worker.start()
            if really_s == 0.0:
                worker.join()
            loop.clock.answer_owed(ours.fileno(), "frame")
            answered_ns = await answered - start_ns
            ticking.cancel()
            worker.join()
            loop.remove_reader(ours.fileno())
        return answered_ns, ticks

    answered_ns, ticks = run_lockstep(main, frame_s=0.055)
    assert answered_ns == 55_000_000
    assert ticks == 6, "time went on up to the moment that the answer was due"


def test_a_process_that_starts_takes_no_simulated_time():
    async def main(loop: LockstepLoop) -> int:
        start_ns = loop.clock.now_ns()
        with started_python("print('up')") as process:
            assert process.stdout is not None
            fd = process.stdout.fileno()
            up: asyncio.Future[int] = loop.create_future()
            loop.add_reader(fd, lambda: (loop.remove_reader(fd), up.set_result(loop.clock.now_ns())))
            loop.clock.answer_owed(fd, "start")
            await asyncio.sleep(5)
            return await up - start_ns

    assert run_lockstep(main) == 0


def test_work_in_a_thread_takes_no_simulated_time_and_fails_where_it_is_awaited():
    async def main(loop: LockstepLoop) -> float:
        began = loop.time()
        await asyncio.gather(asyncio.to_thread(time.sleep, 0.1), asyncio.sleep(0))
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 / 0)
        return loop.time() - began

    assert run_lockstep(main) == 0.0


def test_an_answer_that_never_comes_ends_the_simulation_with_the_reason():
    ended: list[str] = []

    async def main(loop: LockstepLoop) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            loop.add_reader(ours.fileno(), lambda: None)
            loop.clock.answer_owed(ours.fileno(), "frame")
            try:
                await asyncio.sleep(10)
            finally:
                ended.append("cleaned up")
                loop.remove_reader(ours.fileno())

    with pytest.raises(LockstepError, match="no answer"):
        run_lockstep(main, patience_s=0.1)
    assert ended == ["cleaned up"]


def test_a_simulation_in_which_nothing_can_happen_any_more_ends():
    async def main(loop: LockstepLoop) -> None:
        await loop.create_future()

    with pytest.raises(LockstepError, match="nothing is left"):
        run_lockstep(main, patience_s=0.1)


def test_readiness_is_told_in_the_order_of_registration_not_of_descriptors():
    async def main(loop: LockstepLoop) -> list[int]:
        pairs = [socket.socketpair() for _ in range(6)]
        order: list[int] = []
        for number in (3, 0, 5, 1, 4, 2):
            reader, writer = pairs[number]
            writer.send(b"x")

            def read(number: int = number, reader: socket.socket = reader) -> None:
                order.append(number)
                loop.remove_reader(reader.fileno())

            loop.add_reader(reader.fileno(), read)
        await asyncio.sleep(1)
        for pair in pairs:
            for end in pair:
                end.close()
        return order

    assert run_lockstep(main) == [3, 0, 5, 1, 4, 2]


def test_the_real_clock_waits_for_nobody():
    clock = RealClock()
    clock.answer_owed(-1, "frame")
    before_ns = clock.now_ns()
    asyncio.run(clock.sleep_until_ns(before_ns + 10_000_000))
    assert clock.now_ns() - before_ns >= 10_000_000
