"""What is said and done when protection is asked for or let go."""

from __future__ import annotations

from structlog.testing import CapturingLogger

from companion.config import EngagementConfig
from companion.engagement import EngagementControl
from companion.guidance.engagement import Inputs

SEC = 1_000_000_000
GOOD = Inputs(True, None, None, None, None, True)
BAD = Inputs(True, "pose too old", None, None, "vision worker starting", True)


class Bench:
    def __init__(self, config: EngagementConfig) -> None:
        self.given = GOOD
        self.offs: list[str | None] = []
        self.texts: list[str] = []
        self.control = EngagementControl(config, self, speaker=self, log=CapturingLogger(), now_ns=0)

    def inputs(self, now_ns):
        return self.given

    def set_off(self, off, now_ns):
        self.offs.append(off)

    def status_text(self, severity, text):
        self.texts.append(text)


def test_the_switch_is_told_at_the_start_and_at_each_change():
    bench = Bench(EngagementConfig(by="command", engaged_at_start=False))
    assert bench.offs == ["not engaged (at start)"]
    assert bench.control.command(True, 0, "parameter").accepted
    assert bench.offs[-1] is None
    assert bench.control.engaged
    bench.control.command(False, 0, "command of 255/190")
    assert bench.offs[-1] == "not engaged (command of 255/190)"
    assert bench.texts == [
        "void: engaged (parameter)",
        "void: NOT engaged, setpoints pass (command of 255/190)",
    ]


def test_a_refusal_names_everything_and_is_not_repeated_at_the_rate_of_the_remote_control():
    bench = Bench(EngagementConfig(by="rc", engaged_at_start=False))
    bench.given = BAD
    for tick in range(100):
        bench.control.on_rc_channels((1900,) * 8, tick * SEC // 5)
    assert set(bench.texts) == {"void: cannot engage: pose too old; vision worker starting"}
    assert len(bench.texts) == 2  # 20 s
    assert bench.offs == ["not engaged (at start)"]
    bench.given = GOOD
    bench.control.on_rc_channels((1900,) * 8, 20 * SEC)
    assert bench.offs[-1] is None
