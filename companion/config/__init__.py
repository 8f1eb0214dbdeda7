"""The configuration: one frozen model, read strictly from TOML.

Every key has a unit in its name where it has one, a range, a default and an explanation; the commented
default file (``companion config --default``) is generated from here, so that the two cannot disagree.
"""

from __future__ import annotations

from companion.config.camera import CameraConfig
from companion.config.detector import DetectorConfig
from companion.config.engagement import EngagementConfig
from companion.config.ground_station import GroundStationConfig
from companion.config.guidance import GuidanceConfig
from companion.config.link import LinkConfig
from companion.config.log import LogConfig
from companion.config.recorder import RecorderConfig
from companion.config.reload import ReloadConfig
from companion.config.section import Disagreement, DisagreementError, Section
from companion.config.source import SourceConfig
from companion.config.status import StatusConfig
from companion.config.takeover import InterceptionConfig
from companion.config.web import WebConfig

__all__ = [
    "CameraConfig",
    "Config",
    "DetectorConfig",
    "Disagreement",
    "DisagreementError",
    "EngagementConfig",
    "GroundStationConfig",
    "GuidanceConfig",
    "InterceptionConfig",
    "LinkConfig",
    "LogConfig",
    "RecorderConfig",
    "ReloadConfig",
    "SourceConfig",
    "StatusConfig",
    "WebConfig",
]


class Config(Section):
    """The whole configuration."""

    source: SourceConfig = SourceConfig()
    camera: CameraConfig = CameraConfig()
    detector: DetectorConfig = DetectorConfig()
    link: LinkConfig = LinkConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    interception: InterceptionConfig = InterceptionConfig()
    engagement: EngagementConfig = EngagementConfig()
    ground_station: GroundStationConfig = GroundStationConfig()
    log: LogConfig = LogConfig()
    status: StatusConfig = StatusConfig()
    reload: ReloadConfig = ReloadConfig()
    recorder: RecorderConfig = RecorderConfig()
    web: WebConfig = WebConfig()

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if self.camera.file:  # the field of view is then known only to whoever reads that file
            return ()
        half_view_deg = self.camera.hfov_deg / 2
        return tuple(
            Disagreement(
                f"guidance.{key}",
                str(value_deg),
                f"at most half of camera.hfov_deg, which is {half_view_deg:g}",
            )
            for key, value_deg in (
                ("view_deg", self.guidance.view_deg),
                ("turn_step_deg", self.guidance.turn_step_deg),
            )
            if value_deg > half_view_deg
        )
