"""Wrong words to the scripts that build and try the installation end in one line, before anything is made."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["deb", "--python", "three"], 1, "--python: found 'three'; allowed: MAJOR.MINOR, such as 3.11"),
        (["vm-test", "nonsense"], 2, "unknown group 'nonsense'; known: cameras, flight, service"),
    ],
)
def test_wrong_words_are_answered_in_one_line(words, code, said, tmp_path):
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / words[0]), *words[1:]],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (code, f"error: {said}\n")
    assert list(tmp_path.iterdir()) == []
