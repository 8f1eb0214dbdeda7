"""The short form of benchmarks/fuzz_proxy.py: mutated frames and noise through framer and proxy."""

import importlib.util
import random
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

_PATH = Path(__file__).parents[3] / "benchmarks" / "fuzz_proxy.py"
_SPEC = importlib.util.spec_from_file_location("fuzz_proxy", _PATH)
fuzz_proxy = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(fuzz_proxy)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1 << 32))
def test_no_good_frame_is_lost_and_none_is_made_up(seed):
    faults, _ = fuzz_proxy.one_round(random.Random(seed), 60)
    assert faults == []


class _Losing(fuzz_proxy.Side):
    def send(self, datagram):
        return super().send(datagram[:-1] + bytes([datagram[-1] ^ 1]))


def test_the_check_sees_what_is_altered(monkeypatch):
    monkeypatch.setattr(fuzz_proxy, "Side", _Losing)
    assert any(fuzz_proxy.one_round(random.Random(seed), 60)[0] for seed in range(3))
