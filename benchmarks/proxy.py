"""What forwarding costs: ours, MAVProxy and a plain pymavlink loop against a direct link, side by side in one run.

    python benchmarks/proxy.py [--json] [--seconds S] [--rounds N] [--loss-seconds S] [--no-mavproxy]

Loopback UDP. A vehicle's telemetry goes through each contender to a planner; both ends are this process, so that one
clock stamps departure and arrival, and what it costs itself is in the direct link's figure too. Contenders run at the
same time and are asked in turn, in rounds, so that other load on the machine meets all of them. "vision": beside them a
`companion run` with its worker works on the footage that ships with the package; that companion is then also the one
whose forwarding is measured.

MAVProxy is installed from PyPI into an environment of its own, in the folder for caches.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import select
import socket
import statistics
import struct
import subprocess
import sys
import time
import venv
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from companion.sim.companion_process import CompanionProcess
from companion.sim.footage import OFFICE_WALK, OFFICE_WALK_CAMERA

RATES_HZ = (50, 500, 5000)
LADDER_HZ = (1000, 2000, 5000, 10000, 20000, 40000)
ATTITUDE = 30
ATTITUDE_CRC_EXTRA = mavlink.mavlink_map[ATTITUDE].crc_extra
_MAVPROXY = "MAVProxy==1.8.75"

PYMAVLINK_LOOP = """
import socket, sys
from pymavlink.dialects.v20 import common as mavlink
inward = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
inward.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
inward.bind(("127.0.0.1", int(sys.argv[1])))
outward = ("127.0.0.1", int(sys.argv[2]))
parser, packer = mavlink.MAVLink(None), mavlink.MAVLink(None)
parser.robust_parsing = True
while True:
    for message in parser.parse_buffer(inward.recv(65535)) or ():
        if message.get_type() == "BAD_DATA":
            continue
        packer.seq, packer.srcSystem, packer.srcComponent = (
            message.get_seq(), message.get_srcSystem(), message.get_srcComponent())
        try:
            outward_bytes = bytes(message.pack(packer))
        except Exception:
            continue
        inward.sendto(outward_bytes, outward)
"""

SENDER = """
import socket, sys, time
sys.path.insert(0, sys.argv[1])
from benchmarks.proxy import attitude
sock = socket.socket(fileno=int(sys.argv[2]))
entry, rate, seconds, first = (sys.argv[3], int(sys.argv[4])), float(sys.argv[5]), float(sys.argv[6]), int(sys.argv[7])
count = int(rate * seconds)
frames = [attitude(first + i) for i in range(count)]
sock.setblocking(True)
print(flush=True)  # only now: packing takes longer than sending
sys.stdin.readline()
begin = time.perf_counter()
sent, send = 0, sock.sendto
while sent < count:
    due = min(count, int((time.perf_counter() - begin) * rate) + 1)
    for frame in frames[sent:due]:
        send(frame, entry)
    sent = due
    time.sleep(0.0005)
print(time.perf_counter() - begin)
sock.setblocking(False)
sock.detach()
"""


def attitude(number: int) -> bytes:
    """Return a MAVLink 2 ATTITUDE that carries a number, packed without pymavlink's per-message cost."""
    body = struct.pack("<BBBBBB3sI6f", 28, 0, 0, number % 256, 1, 1, b"\x1e\0\0", number, *([0.1] * 5), 1.0)
    crc = mavlink.x25crc(body + bytes([ATTITUDE_CRC_EXTRA])).crc
    return b"\xfd" + body + struct.pack("<H", crc)


def heartbeat(kind: int, autopilot: int, system: int, component: int) -> bytes:
    sender = mavlink.MAVLink(None, system, component)
    return bytes(mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3).pack(sender))


VEHICLE_HEARTBEAT = heartbeat(2, 12, 1, 1)
PLANNER_HEARTBEAT = heartbeat(6, 8, 255, 190)


def mixed_frames(count: int) -> list[bytes]:
    """Return frames of both protocol versions, signed ones and ones of unknown messages; none is a setpoint."""
    rng = random.Random(5)  # noqa: S311  the same frames each time
    frames: list[bytes] = []
    for number in range(count):
        message_id = rng.choice([0, 24, 30, 32, 33, 74, 105, 331])
        message = mavlink.mavlink_map[message_id]
        form = rng.choice(["v1", "v2", "v2", "signed", "unknown"])
        if form == "unknown":
            body = rng.randbytes(rng.randint(1, 60))
            head = struct.pack("<BBBBBB", len(body), 0, 0, number % 256, 1, 1) + (60000).to_bytes(3, "little")
            frames.append(b"\xfd" + head + body + rng.randbytes(2))
            continue
        # Numbers that a receiver may use are kept small and finite; the last byte is not 0, or it would be trimmed.
        length = message.unpacker.size
        body = bytes(rng.choices(range(1, 60), k=length))
        if form == "v1" and message_id < 256 and length <= 255:
            head, magic = struct.pack("<BBBBB", length, number % 256, 1, 1, message_id), b"\xfe"
        else:
            flags = 1 if form == "signed" else 0
            head = struct.pack("<BBBBBB", length, flags, 0, number % 256, 1, 1) + message_id.to_bytes(
                3, "little"
            )
            magic = b"\xfd"
        crc = mavlink.x25crc(head + body + bytes([message.crc_extra])).crc
        tail = rng.randbytes(13) if magic == b"\xfd" and form == "signed" else b""
        frames.append(magic + head + body + struct.pack("<H", crc) + tail)
    return frames


def open_socket() -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 32 << 20)  # as much as the kernel grants
    opened.bind(("127.0.0.1", 0))
    opened.setblocking(False)
    return opened


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Contender:
    """One way from the vehicle's socket to the planner's."""

    name: str
    vehicle: socket.socket
    planner: socket.socket
    entry: tuple[str, int]
    pid: int | None = None
    planner_entry: tuple[str, int] | None = None
    first_number: int = 0
    latencies_us: dict[int, list[float]] = field(default_factory=dict)
    lost: dict[int, int] = field(default_factory=dict)
    cpu_us: dict[int, list[float]] = field(default_factory=dict)
    most_hz: int = 0
    ladder: dict[int, int] = field(default_factory=dict)
    altered: int | None = None
    missing: int = 0
    rss_mib: float | None = None

    def greet(self) -> None:
        """Let both ends be known, and take what is waiting."""
        self.vehicle.sendto(VEHICLE_HEARTBEAT, self.entry)
        if self.planner_entry is not None:
            self.planner.sendto(PLANNER_HEARTBEAT, self.planner_entry)

    def next_numbers(self) -> int:
        """Return where the numbers of the next measurement begin: what is still under way has others."""
        self.first_number += 1 << 20
        return self.first_number

    def drain(self) -> None:
        for end in (self.vehicle, self.planner):
            while True:
                try:
                    end.recv(65535)
                except (BlockingIOError, ConnectionRefusedError):
                    break

    def cpu_ns(self) -> int:
        """Return the processor time of the forwarding process; its children (the vision worker) are not in it."""
        if self.pid is None:
            return 0
        total = 0
        for task in Path(f"/proc/{self.pid}/task").iterdir():
            total += int((task / "schedstat").read_text().split()[0])
        return total


def frames_in(data: bytes) -> Iterator[bytes]:
    at = 0
    while at + 8 <= len(data):
        if data[at] == 0xFD:
            end = at + 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        elif data[at] == 0xFE:
            end = at + 8 + data[at + 1]
        else:
            return
        yield data[at:end]
        at = end


def numbers_in(data: bytes) -> Iterator[int]:
    for frame in frames_in(data):
        if frame[0] == 0xFD and frame[7:10] == b"\x1e\0\0":
            yield int.from_bytes(frame[10:14].ljust(4, b"\0"), "little")


def measure_latency(contender: Contender, rate_hz: int, seconds: float) -> None:
    """Send at a rate from this process, and take the time until each message is back."""
    contender.greet()
    time.sleep(0.1)
    contender.drain()
    count = max(20, int(rate_hz * seconds))
    first = contender.next_numbers()
    frames = [attitude(first + number) for number in range(count)]
    sent_ns, arrived_ns = [0] * count, [0] * count
    vehicle, planner, clock = contender.vehicle, contender.planner, time.perf_counter_ns
    idle_ns, idle_begin = contender.cpu_ns(), clock()
    time.sleep(0.3)
    idle_share = (contender.cpu_ns() - idle_ns) / (clock() - idle_begin)
    cpu_begin, begin = contender.cpu_ns(), clock()
    number, period_ns, deadline = 0, 1e9 / rate_hz, None
    arrived = 0
    while arrived < count:
        now = clock()
        while number < count and now >= begin + number * period_ns:
            sent_ns[number] = clock()
            vehicle.sendto(frames[number], contender.entry)
            number += 1
            if number % 8 == 0:  # behind schedule: look at the other end too
                break
        if number == count:
            deadline = deadline or now + 2_000_000_000
            if now > deadline:
                break
        next_ns = begin + number * period_ns if number < count else now + 50_000_000
        wait_s = max(0.0, (next_ns - clock()) / 1e9)
        if select.select([planner], [], [], wait_s)[0]:
            try:
                data = planner.recv(65535)
            except BlockingIOError:
                continue
            at = clock()
            for got in (seen - first for seen in numbers_in(data)):
                if 0 <= got < count and not arrived_ns[got]:
                    arrived_ns[got] = at
                    arrived += 1
    elapsed = clock() - begin
    cpu = contender.cpu_ns() - cpu_begin - idle_share * elapsed
    contender.cpu_us.setdefault(rate_hz, []).append(max(0.0, cpu) / 1e3 / count)
    took = [(a - s) / 1e3 for s, a in zip(sent_ns, arrived_ns, strict=True) if a]
    contender.latencies_us.setdefault(rate_hz, []).extend(took)
    contender.lost[rate_hz] = contender.lost.get(rate_hz, 0) + count - len(took)


def measure_loss(contender: Contender, rate_hz: int, seconds: float) -> tuple[int, float]:
    """Send at a rate from another process; return how many were lost, and the rate that was reached.

    Frames are packed before and read after: while they are under way, this process does nothing but take datagrams from the
    kernel and the other one nothing but give them to it.
    """
    contender.greet()
    time.sleep(0.1)
    contender.drain()
    root = str(Path(__file__).resolve().parents[1])
    vehicle, first = contender.vehicle.fileno(), contender.next_numbers()
    numbers = map(str, (vehicle, *contender.entry, rate_hz, seconds, first))
    sender = subprocess.Popen(
        [sys.executable, "-c", SENDER, root, *numbers],
        pass_fds=[vehicle],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert sender.stdin is not None
    assert sender.stdout is not None
    sender.stdout.readline()
    count = int(rate_hz * seconds)
    taken: list[bytes] = []
    take, waits = contender.planner.recv, select.poll()
    waits.register(contender.planner, select.POLLIN)
    sender.stdin.write(b"\n")
    sender.stdin.flush()
    while waits.poll(1500) or sender.poll() is None:
        with suppress(BlockingIOError):
            while True:
                taken.append(take(65535))
        if len(taken) >= count and sender.poll() is not None:
            break
    elapsed = float(sender.communicate()[0] or b"inf")
    seen = {number for data in taken for number in numbers_in(data) if first <= number < first + count}
    return count - len(seen), count / elapsed


def measure_altered(contender: Contender, frames: list[bytes], rate_hz: float = 2000.0) -> None:
    """Send frames of every kind; those that do not arrive as they left are altered or missing."""
    contender.greet()
    time.sleep(0.1)
    contender.drain()
    got: list[bytes] = []

    def collect(wait_s: float) -> bool:
        if not select.select([contender.planner], [], [], wait_s)[0]:
            return False
        try:
            got.extend(frames_in(contender.planner.recv(65535)))
        except BlockingIOError:
            return False
        return True

    begin = time.perf_counter()
    for number, frame in enumerate(frames):
        contender.vehicle.sendto(frame, contender.entry)
        while time.perf_counter() < begin + (number + 1) / rate_hz:
            collect(max(0.0, begin + (number + 1) / rate_hz - time.perf_counter()))
    while collect(0.5):
        pass
    left = {}
    for frame in frames:
        left[frame] = left.get(frame, 0) + 1
    altered = 0
    ours = (191, 230)  # what a proxy says as a component of its own is no altered frame
    for frame in got:
        if left.get(frame):
            left[frame] -= 1
        else:
            at = 5 if frame[0] == 0xFD else 3
            altered += frame[at] == 1 and frame[at + 1] not in ours and frame != VEHICLE_HEARTBEAT
    contender.altered, contender.missing = altered, max(0, sum(left.values()) - altered)


def mavproxy_python() -> Path:
    """Return the interpreter of MAVProxy's own environment, which is made where it is not there."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "void-companion" / "mavproxy"
    python = cache / "bin" / "python"
    if not (cache / "bin" / "mavproxy.py").exists():
        print(f"installing {_MAVPROXY} into {cache}", file=sys.stderr)
        venv.create(cache, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "-q", _MAVPROXY, "setuptools<81"], check=True)
    return python


@contextmanager
def running(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd="/tmp",  # noqa: S108  MAVProxy leaves its logs where it runs
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


async def open_companion(stack: AsyncExitStack, *, vision: bool, event_loop: str) -> Contender:
    tables: dict[str, dict[str, object]] = {"link": {"event_loop": event_loop}, "log": {"level": "info"}}
    if vision:
        tables["source"] = {"url": f"file:{OFFICE_WALK}", "loop": True}
        tables["camera"] = {"file": str(OFFICE_WALK_CAMERA)}
    else:
        # A source that never comes: nothing is decoded and the worker idles.
        tables["source"] = {"url": f"tcp:127.0.0.1:{free_port()}"}
    service = await stack.enter_async_context(CompanionProcess(tables))
    started = await service.wait_for("service_started", 60.0)
    if vision:
        await service.wait_for("source_started", 120.0)

    def address(key: str) -> tuple[str, int]:
        host, _, port = str(started[key]).rpartition(":")
        return host, int(port)

    name = f"void-companion ({'uvloop' if event_loop == 'auto' else 'asyncio'})"
    return Contender(
        name, open_socket(), open_socket(), address("autopilot"), service.pid, address("planner")
    )


def open_mavproxy(stack: AsyncExitStack) -> Contender:
    port, planner = free_port(), open_socket()
    command = [
        str(mavproxy_python()),
        str(mavproxy_python().parent / "mavproxy.py"),
        f"--master=udpin:127.0.0.1:{port}",
        f"--out=udpout:127.0.0.1:{planner.getsockname()[1]}",
        "--non-interactive",
        "--streamrate=-1",
        "--default-modules=",
        "--nowait",
        "--mav20",
    ]
    process = stack.enter_context(running(command))
    return Contender("MAVProxy", open_socket(), planner, ("127.0.0.1", port), process.pid)


def open_pymavlink(stack: AsyncExitStack) -> Contender:
    port, planner = free_port(), open_socket()
    process = stack.enter_context(
        running([sys.executable, "-c", PYMAVLINK_LOOP, str(port), str(planner.getsockname()[1])])
    )
    return Contender("pymavlink loop", open_socket(), planner, ("127.0.0.1", port), process.pid)


def open_direct() -> Contender:
    planner = open_socket()
    return Contender("direct", open_socket(), planner, planner.getsockname())


def wait_until_it_forwards(contender: Contender, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        contender.greet()
        contender.vehicle.sendto(attitude(7), contender.entry)
        if select.select([contender.planner], [], [], 0.2)[0] and 7 in numbers_in(
            contender.planner.recv(65535)
        ):
            return
    raise SystemExit(f"{contender.name} forwards nothing")


def rss_mib(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return 0.0


async def measure(arguments: argparse.Namespace, *, vision: bool, progress: Callable[[str], None]) -> dict:
    async with AsyncExitStack() as stack:
        contenders = [open_direct(), open_pymavlink(stack)]
        if not arguments.no_mavproxy:
            contenders.append(open_mavproxy(stack))
        contenders.append(await open_companion(stack, vision=vision, event_loop="auto"))
        if not vision:  # one companion with vision is the load of one drone
            contenders.append(await open_companion(stack, vision=False, event_loop="asyncio"))
        for contender in contenders:
            wait_until_it_forwards(contender)
        for rate_hz in RATES_HZ:
            for _ in range(arguments.rounds):
                for contender in contenders:
                    progress(f"{'vision' if vision else 'no vision'}: {contender.name} at {rate_hz}/s")
                    measure_latency(contender, rate_hz, arguments.seconds)
                    await asyncio.sleep(0)
        for contender in contenders:
            progress(f"{contender.name}: altered frames, greatest rate")
            measure_altered(contender, mixed_frames(arguments.mixed))
            for rate_hz in LADDER_HZ:
                seconds = arguments.loss_seconds if rate_hz == 20000 else min(2.0, arguments.loss_seconds)
                lost, reached = measure_loss(contender, rate_hz, seconds)
                contender.ladder[rate_hz] = lost
                if lost or reached < 0.9 * rate_hz:
                    break
                contender.most_hz = rate_hz
                await asyncio.sleep(0)
            if contender.pid is not None:
                contender.rss_mib = rss_mib(contender.pid)
        return {contender.name: row_of(contender, contenders[0]) for contender in contenders}


def row_of(contender: Contender, direct: Contender) -> dict:
    row: dict = {"rss_mib": contender.rss_mib, "most_hz": contender.most_hz, "altered": contender.altered}
    row |= {"missing": contender.missing, "lost_by_rate": contender.ladder, "rates": {}}
    for rate_hz in RATES_HZ:
        ours, base = contender.latencies_us.get(rate_hz, []), direct.latencies_us.get(rate_hz, [])
        if len(ours) < 2 or len(base) < 2:
            row["rates"][rate_hz] = {"lost": contender.lost.get(rate_hz, 0)}
            continue
        p50, p99 = (statistics.quantiles(ours, n=100)[at] for at in (49, 98))
        row["rates"][rate_hz] = {
            "p50_us": p50,
            "p99_us": p99,
            "added_p50_us": p50 - statistics.median(base),
            "added_p99_us": p99 - statistics.quantiles(base, n=100)[98],
            "cpu_us": statistics.median(contender.cpu_us[rate_hz]),
            "lost": contender.lost[rate_hz],
        }
    return row


def print_table(result: dict) -> None:
    for title, rows in result.items():
        print(f"\n{title}\n")
        print(
            "| | added p50 / p99, us, at 50/s | at 500/s | at 5000/s | CPU, us a message, at 50 / 500 / 5000 | most without loss | RSS, MiB | altered / missing |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for name, row in rows.items():
            rates = [row["rates"][rate_hz] for rate_hz in RATES_HZ]
            added = " | ".join(
                f"{rate['added_p50_us']:.0f} / {rate['added_p99_us']:.0f}" if "p50_us" in rate else "all lost"
                for rate in rates
            )
            cpu = " / ".join(f"{rate['cpu_us']:.0f}" if "cpu_us" in rate else "-" for rate in rates)
            rss = "-" if row["rss_mib"] is None else f"{row['rss_mib']:.0f}"
            print(
                f"| {name} | {added} | {cpu} | {row['most_hz']}/s | {rss} | {row['altered']} / {row['missing']} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=3.0, help="of one measurement at one rate")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--loss-seconds", type=float, default=10.0, help="at 20 000 messages a second")
    parser.add_argument("--mixed", type=int, default=20000, help="frames that are compared byte for byte")
    parser.add_argument("--no-mavproxy", action="store_true")
    arguments = parser.parse_args()

    def progress(text: str) -> None:
        print(text, file=sys.stderr)

    if not arguments.no_mavproxy:
        mavproxy_python()
    result = {}
    for vision in (False, True):
        result["with vision" if vision else "without vision"] = asyncio.run(
            measure(arguments, vision=vision, progress=progress)
        )
    if arguments.json:
        print(json.dumps(result))
    else:
        print_table(result)


if __name__ == "__main__":
    main()
