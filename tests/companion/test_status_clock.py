"""Nothing that decides, times out or waits reads the wall clock: NTP may set it by hours while flying.

What a jump does to the running service is in ``tests/integration/test_service_faults.py``.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
WALL_CLOCK = {
    *(f"time.{name}" for name in ("time", "time_ns", "ctime", "localtime", "gmtime", "strftime")),
    *(f"datetime.{name}" for name in ("now", "utcnow", "today")),
    *(f"datetime.datetime.{name}" for name in ("now", "utcnow", "today")),
    *("date.today", "datetime.date.today"),
}
MAY = {
    "companion/mavlink/arrival.py": "the kernel stamps datagrams by it; what cannot be a wait is not believed",
    "companion/mavlink/signing.py": "MAVLink's signatures carry the time since 2015; ours never go back",
    "companion/recorder/sink.py": "recordings are named and dated by it",
    "companion/recorder/disk.py": "writes such a name",
}


def wall_clock_in(source: str) -> list[str]:
    names = [ast.unparse(node) for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Attribute)]
    imported = [
        f"{node.module}.{name.name}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    ]
    return [name for name in (*names, *imported) if name in WALL_CLOCK]


def test_the_wall_clock_is_read_by_those_that_may_only():
    found = {}
    for package in ("companion", "detector"):
        for path in sorted((ROOT / package).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            if not name.startswith("companion/sim/") and (read := wall_clock_in(path.read_text("utf-8"))):
                found[name] = read
    assert {name: read for name, read in found.items() if name not in MAY} == {}
    assert found, "not even the signatures: is it looked for rightly?"


def test_reading_it_is_noticed():
    assert wall_clock_in("import time\nage_s = time.time() - seen_s") == ["time.time"]
    assert wall_clock_in("from time import time_ns") == ["time.time_ns"]
    assert wall_clock_in("import datetime\ndatetime.datetime.now()") == ["datetime.datetime.now"]
    assert wall_clock_in("import time\ntime.monotonic_ns()") == []
