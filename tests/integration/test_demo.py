"""The demo is the README's first command: it must run, add up and lose nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import pytest


@pytest.mark.slow
@pytest.mark.timeout(420)
def test_the_demo_runs_to_its_end_and_its_figures_add_up(tmp_path: Path):
    result = subprocess.run(
        [sys.executable, "-m", "companion", "demo", "--json", "-o", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    summary = json.loads(result.stdout)
    counts = [summary[name] for name in ("forwarded", "substituted", "held", "turned", "dropped")]
    assert sum(counts) == summary["setpoints_in"] > 200
    assert summary["substituted"] > 20
    assert summary["turned"] > 0
    assert (summary["z_changed"], summary["lost"], summary["altered_other"]) == (0, 0, 0)
    assert summary["frames"] >= 150
    assert summary["detections"].get("single_plane", 0) > 0
    assert summary["detections"].get("gap", 0) > 50
    for name in ("detection_ms", "frame_to_setpoint_ms"):
        assert 0 < summary[name]["p50"] <= summary[name]["p95"]
    for part in ("footage", "room"):
        video = cv2.VideoCapture(summary["parts"][part]["video"])
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) > 50
        ok, picture = video.read()
        video.release()
        assert ok
        assert picture.std() > 20
