from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from companion.cli import main
from companion.sim.footage import OFFICE_WALK


def answer_of(address: str, path: str) -> Any:
    with urllib.request.urlopen(f"{address}{path}", timeout=60) as answer:  # noqa: S310  it begins with http
        return json.load(answer)


def test_recordings_are_served_without_a_drone_until_ctrl_c() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "companion", "web", str(OFFICE_WALK), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            address = re.match(r"(http://127\.0\.0\.1:\d+/) ", process.stdout.readline())
            assert address is not None
            assert answer_of(address[1], "api/session") == {"api": 1, "token_needed": False, "live": False}
            (recording,) = answer_of(address[1], "api/recordings")["recordings"]
            # By the worker process, which ends with this one.
            assert answer_of(address[1], f"api/recordings/{recording['id']}")["pictures"] == 220
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing-there"], "nothing-there: no such file or folder"),
        (["."], "no recording, video or folder of images in it"),
        ([".", "--port", "70000"], "--port 70000: allowed: 0 to 65535"),
        ([".", "-o", "web.host=0.0.0.0"], "web.host: found"),
    ],
)
def test_what_cannot_be_served_is_said_in_a_line(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["web", *words]) == 1
    assert said in capsys.readouterr().err
