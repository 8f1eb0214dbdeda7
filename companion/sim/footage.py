"""The real footage that ships with the package. See its README and LICENSE beside it."""

from __future__ import annotations

from pathlib import Path

OFFICE_WALK = Path(__file__).parent / "data" / "office_walk"
"""A walk through an office: a folder of images with timestamps.csv, poses.csv and camera.toml. Nominal times."""

OFFICE_WALK_POSES = OFFICE_WALK / "poses.csv"
"""For ``RecordedPoses.load``."""

OFFICE_WALK_CAMERA = OFFICE_WALK / "camera.toml"
"""For the detector's and the service's camera file."""
