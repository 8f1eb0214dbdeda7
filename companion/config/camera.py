"""``[camera]``: intrinsics and mounting."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.section import Section


class CameraConfig(Section):
    """The camera and how it is mounted."""

    hfov_deg: Annotated[
        float,
        Field(
            gt=5,
            lt=170,
            description="Horizontal field of view, used when no calibration file is given. Larger than it is: directions too far to the side; smaller: too near to the middle (deg).",
        ),
    ] = 70.0
    file: Annotated[
        str, Field(description="Camera file (TOML) with intrinsics and distortion; empty: hfov_deg alone.")
    ] = ""
    mount_roll_deg: Annotated[
        float,
        Field(
            ge=-180,
            le=180,
            description="Rotation of the camera about the body's forward axis; larger: further clockwise as seen from behind (deg).",
        ),
    ] = 0.0
    mount_pitch_deg: Annotated[
        float, Field(ge=-90, le=90, description="Camera tilt; positive looks up, larger: further up (deg).")
    ] = 0.0
    mount_yaw_deg: Annotated[
        float,
        Field(
            ge=-180,
            le=180,
            description="Camera pan; positive looks to the right, larger: further to the right (deg).",
        ),
    ] = 0.0
