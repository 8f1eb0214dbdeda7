"""Mutated frames and random chunks through the framer and the proxy, until a count is reached.

    python benchmarks/fuzz_proxy.py [--frames 1000000] [--seed N] [--json]
    python benchmarks/fuzz_proxy.py --untouched [--frames 1000000]

Each round is a stream of good frames (both versions, signed ones, unknown messages), mutated ones and noise, cut at random places,
through a real `InlineProxy` in one direction or the other. It fails on an exception, on a good frame of a known message that does
not come out, on a frame that comes out and never went in, and on a chunk that takes longer than `--most-ms`.

`--untouched` sends good frames alone, of both versions, signed and of unknown messages, in whole datagrams of one to five, in both
directions, and fails where what comes out is not byte for byte what went in.

The short form of this runs in the tests (tests/companion/mavlink/test_proxy_fuzz.py).
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections import Counter

from pymavlink.dialects.v20 import common as mavlink

from companion.mavlink.endpoint import LinkCounters
from companion.mavlink.framing import Framer, RawFrame
from companion.mavlink.proxy import InlineProxy

SETPOINTS = (82, 84, 86)
KNOWN = tuple(sorted(set(mavlink.mavlink_map) - set(SETPOINTS)))
UNKNOWN = (433, 60000, 0xFFFFFF)


class Side:
    """One side of the proxy without a socket; each chunk is what one datagram or read holds."""

    def __init__(self) -> None:
        self.on_frames = None
        self.counters = LinkCounters()
        self.sent: list[bytes] = []
        self._framer = Framer(self.counters.framing)

    def send(self, datagram: bytes) -> int:
        self.sent.append(datagram)
        return 1

    def receive(self, chunk: bytes) -> None:
        frames: list[RawFrame] = self._framer.feed(chunk)
        if frames:
            self.on_frames(frames)


class Nobody:
    """A handler that must never be asked to decide: no setpoint is sent here."""

    def on_setpoint(self, *_: object) -> object:
        raise AssertionError("a setpoint came out of frames that hold none")

    def on_unprotected(self, *_: object) -> None: ...

    def on_rivals(self, *_: object) -> None: ...

    def on_refused_signature(self, *_: object) -> None: ...

    def on_engage_request(self, *_: object) -> None: ...

    def on_telemetry(self, *_: object) -> None: ...


def good_frame(rng: random.Random) -> tuple[bytes, bool]:
    """Return a frame and whether its checksum can be verified."""
    form = rng.choice(("v1", "v2", "v2", "signed", "unknown"))
    message_id = rng.choice(UNKNOWN if form == "unknown" else KNOWN)
    extra = 0xA7 if form == "unknown" else mavlink.mavlink_map[message_id].crc_extra
    body = rng.randbytes(rng.choice((1, 9, 28, 53, rng.randint(1, 255))))
    ids = bytes([rng.randint(0, 255), rng.choice((1, 255)), rng.choice((1, 190))])
    if form == "v1" and message_id < 256:
        head, magic, tail = bytes([len(body)]) + ids + bytes([message_id]), b"\xfe", b""
    else:
        signed = form == "signed"
        head = bytes([len(body), signed, 0]) + ids + message_id.to_bytes(3, "little")
        magic, tail = b"\xfd", rng.randbytes(13) if signed else b""
    crc = mavlink.x25crc(head + body + bytes([extra])).crc
    return magic + head + body + crc.to_bytes(2, "little") + tail, form != "unknown"


def mutated(rng: random.Random) -> bytes:
    data = bytearray(good_frame(rng)[0])
    match rng.randrange(5):
        case 0:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1:
            del data[rng.randrange(len(data)) :]
        case 2:
            at = rng.randrange(len(data))
            data[at:at] = rng.randbytes(rng.randint(1, 20))
        case 3:
            data = bytearray(rng.choice((b"\xfd", b"\xfe")) * rng.randint(1, 300))
        case 4:
            data = bytearray(rng.randbytes(rng.randint(1, 100)))
    return bytes(data)


def one_round(rng: random.Random, parts: int) -> tuple[list[str], float]:
    """Send one stream and return what was wrong, and the longest time of a chunk in ms."""
    planner, autopilot = Side(), Side()
    proxy = InlineProxy(planner, autopilot, Nobody(), now_ns=time.monotonic_ns)
    source, sink = (planner, autopilot) if rng.random() < 0.5 else (autopilot, planner)
    stream, good = bytearray(), []
    for _ in range(parts):
        if rng.random() < 0.5:
            data, verifiable = good_frame(rng)
            if verifiable:
                good.append(data)
        else:
            data = mutated(rng)
        stream += data
    faults, worst_ms, at = [], 0.0, 0
    whole = bytes(stream)
    while at < len(whole):
        step = rng.choice((rng.randint(1, 40), rng.randint(40, 1500)))
        begin = time.perf_counter()
        source.receive(whole[at : at + step])
        worst_ms = max(worst_ms, 1e3 * (time.perf_counter() - begin))
        at += step
    # What a mutation left open at the end may still be waited for: a long quiet stretch ends the wait.
    source.receive(bytes(300))
    whole += bytes(300)
    out = b"".join(sink.sent)
    if proxy.counters.handler_errors:
        faults.append(f"{proxy.counters.handler_errors} handler errors")
    position = 0
    for number, data in enumerate(good):
        found = out.find(data, position)
        if found < 0:
            faults.append(f"good frame {number} of {len(good)} was lost: {data.hex()}")
            break
        position = found + len(data)
    faults += [
        f"sent what never came: {datagram.hex()}" for datagram in sink.sent if not _all_came(datagram, whole)
    ]
    return faults, worst_ms


def _all_came(datagram: bytes, whole: bytes) -> bool:
    if datagram in whole:
        return True
    at = 0
    while at < len(datagram):  # frames that stood apart, with garbage between them
        size = datagram[at + 1] + (8 if datagram[at] == 0xFE else 12 + 13 * (datagram[at + 2] & 1))
        if datagram[at] not in (0xFD, 0xFE) or datagram[at : at + size] not in whole:
            return False
        at += size
    return True


def untouched_round(rng: random.Random, frames: int) -> list[str]:
    """Send good frames through a proxy; return what did not come out as it went in."""
    planner, autopilot = Side(), Side()
    InlineProxy(planner, autopilot, Nobody(), now_ns=time.monotonic_ns)
    source, sink = rng.choice(((planner, autopilot), (autopilot, planner)))
    sent: list[bytes] = []
    left = frames
    while left > 0:
        size = min(left, rng.choice((1, 1, 1, 2, 5)))
        sent.append(b"".join(good_frame(rng)[0] for _ in range(size)))
        source.receive(sent[-1])
        left -= size
    whole, out = b"".join(sent), b"".join(sink.sent)
    if whole == out:
        return []
    at = next(
        (i for i, (a, b) in enumerate(zip(whole, out, strict=False)) if a != b), min(len(whole), len(out))
    )
    return [f"byte {at} of {len(whole)} is another one; {len(out)} came out"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--most-ms", type=float, default=2000.0, help="longest time of one chunk")
    parser.add_argument("--untouched", action="store_true", help="good frames alone, compared byte for byte")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    done, worst_ms, faults, parts = 0, 0.0, Counter(), 200
    begin = time.perf_counter()
    while done < arguments.frames:
        seed = arguments.seed + done
        rng = random.Random(seed)  # noqa: S311  a round can be repeated by its seed
        found, took_ms = (untouched_round(rng, parts), 0.0) if arguments.untouched else one_round(rng, parts)
        worst_ms = max(worst_ms, took_ms)
        if took_ms > arguments.most_ms:
            found.append("a chunk took too long")
        for fault in found:
            print(f"seed {seed}: {fault[:300]}", file=sys.stderr)
            faults["faults"] += 1
        done += parts
    result = {
        "parts": done,
        "faults": faults["faults"],
        "worst_chunk_ms": round(worst_ms, 1),
        "seconds": round(time.perf_counter() - begin),
    }
    print(json.dumps(result) if arguments.json else result)
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
