"""Sinks that misbehave, for the I/O process of tests. They write what they saw to the folder of recordings."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np

from companion.errors import ConfigError
from companion.io.sink import Kind, Wants

ALL = Wants(frozenset({Kind.FRAME, Kind.POSE, Kind.MAVLINK, Kind.STATE, Kind.LINK, Kind.LOG, Kind.CONFIG}))


class Writing:
    """Appends one line a message to ``seen.jsonl``."""

    def __init__(self, config, desk) -> None:
        self.desk = desk
        self.folder = Path(config.recorder.folder)

    def start(self) -> None:
        self.file = (self.folder / "seen.jsonl").open("a")
        self.write({"did": "start", "pid": os.getpid()})
        self.desk.want(ALL)

    def take(self, message) -> None:
        line = {"did": "take", "kind": message.kind, "seq": message.seq, "fields": dict(message.fields)}
        if message.image is not None:
            line["sum"] = int(np.sum(message.image, dtype=np.int64))
            line["shape"] = message.image.shape
        if message.data:
            line["data"] = message.data[:4].hex()
        self.write(line)
        if message.kind is Kind.CONTROL:
            match message.fields["name"]:
                case "ask":
                    answer = self.desk.ask("double", {"value": 21}).result(timeout=30)
                    self.write({"did": "answered", "accepted": answer.accepted, **answer.fields})
                    refused = self.desk.ask("nothing", {}).result(timeout=30)
                    self.write({"did": "refused", "reasons": refused.reasons})
                case "say":
                    self.desk.log.warning("sink_says", text="hello")
                    os.write(1, b"printed by a sink\n")
                case "fail":
                    raise RuntimeError("a fault of this sink")
                case "exit":
                    os._exit(7)

    def idle(self) -> None:
        pass

    def stop(self) -> None:
        self.write({"did": "stop"})
        self.file.close()

    def write(self, line) -> None:
        self.file.write(json.dumps(line) + "\n")
        self.file.flush()


class Slow(Writing):
    """Takes its time with everything, and for ever to stop."""

    def start(self) -> None:
        self.file = (self.folder / "slow.jsonl").open("a")
        self.desk.want(ALL)

    def take(self, message) -> None:
        time.sleep(0.2)
        self.write({"dropped": sum(self.desk.dropped.values())})

    def stop(self) -> None:
        time.sleep(600)


def unusable(config, desk):
    raise ConfigError("recorder.folder: found nothing of use; allowed: something else")


def hanging(config, desk):
    time.sleep(600)


writing = Writing
slow = Slow
