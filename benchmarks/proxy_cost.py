"""What one message costs in the proxy, against decoding and re-encoding it with pymavlink, in one run.

    python benchmarks/proxy_cost.py [--json] [--frames N]

No sockets: only the work on the bytes. Rounds of both alternate, so that other load on the machine meets both; the
median of the rounds counts, and the ratio is what means something.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from companion.guidance.setpoint import LocalSetpoint, Rewrite, Verdict
from companion.mavlink.framing import Framer
from companion.mavlink.link import LinkCounters
from companion.mavlink.proxy import InlineProxy


class Sink:
    """One side without a socket."""

    def __init__(self) -> None:
        self.on_frames = None
        self.counters = LinkCounters()

    def send(self, datagram: bytes) -> int:
        return len(datagram)


class Steer:
    """Replaces every setpoint."""

    def on_setpoint(self, setpoint: LocalSetpoint, system_id: int, component_id: int, now_ns: int) -> Verdict:
        return Rewrite(setpoint.x + 1.0, setpoint.y, 0.3, "substituted")

    def on_unprotected(self, kind: str, detail: str) -> None: ...

    def on_rivals(self, sources: object, now_ns: int) -> None: ...

    def on_refused_signature(self, source: object, reason: str) -> None: ...

    def on_engage_request(self, request: object, now_ns: int) -> None: ...

    def on_telemetry(self, message: object, now_ns: int) -> None: ...


def traffic(count: int) -> dict[str, list[bytes]]:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    attitude, setpoint = [], []
    for i in range(count):
        sender.seq = i % 256
        attitude.append(bytes(mavlink.MAVLink_attitude_message(i, 0.1, 0.2, 0.3, 0, 0, 0).pack(sender)))
        setpoint.append(
            bytes(
                mavlink.MAVLink_set_position_target_local_ned_message(
                    i, 1, 1, 1, 3576, 1.0, 2.0, -1.2, 0, 0, 0, 0, 0, 0, 0, 0
                ).pack(sender)
            )
        )
    return {"telemetry": attitude, "setpoint": setpoint}


def through_proxy(frames: list[bytes], *, up: bool) -> Callable[[], None]:
    planner, autopilot = Sink(), Sink()
    InlineProxy(planner, autopilot, Steer(), now_ns=time.monotonic_ns)
    framer = Framer()
    side = planner if up else autopilot

    def run() -> None:
        for frame in frames:
            side.on_frames(framer.feed(frame))

    return run


def through_pymavlink(frames: list[bytes]) -> Callable[[], None]:
    parser, packer = mavlink.MAVLink(None), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def run() -> None:
        for frame in frames:
            for message in parser.parse_buffer(frame) or ():
                message.pack(packer)

    return run


def median_us(run: Callable[[], None], other: Callable[[], None], count: int) -> tuple[float, float]:
    ours, theirs = [], []
    for _ in range(7):
        for times, work in ((ours, run), (theirs, other)):
            begin = time.perf_counter()
            work()
            times.append((time.perf_counter() - begin) / count * 1e6)
    return statistics.median(ours), statistics.median(theirs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = {}
    for name, frames in traffic(arguments.frames).items():
        ours, theirs = median_us(
            through_proxy(frames, up=name == "setpoint"), through_pymavlink(frames), len(frames)
        )
        result[name] = {"proxy_us": ours, "pymavlink_us": theirs, "pymavlink_over_proxy": theirs / ours}
    if arguments.json:
        print(json.dumps(result))
        return
    for name, row in result.items():
        print(
            f"{name:10s} proxy {row['proxy_us']:5.1f} us, pymavlink decode and encode {row['pymavlink_us']:5.1f} us:"
            f" {row['pymavlink_over_proxy']:.1f} times"
        )


if __name__ == "__main__":
    main()
