"""Rivals for scale: flown by the simulator, unknown to the service."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from pydantic import ValidationError

from companion.cli import main
from companion.config import CameraConfig, Config, DetectorConfig
from companion.errors import CompanionError
from companion.frames.source import Frame
from companion.guidance.observation import Pose
from companion.sim import rivals
from companion.sim.flight import RIVALS, FlightError, FlightSpec, fly, judged
from companion.sim.scene import empty_room
from companion.vision.pipeline import load_factory
from tests.fakes.pair_views import CAMERA, corridor_view
from tests.fakes.ray_cast_place import ray_cast_place

ROOM = ray_cast_place("room", partial(empty_room, 14.0, 9.0, 3.0, behind_m=3.0), 6.0)
NORTH = (1.0, 0.0, 0.0, 0.0)


def reports(rival: str) -> list[str | tuple[float | None, float | None]]:
    """What a rival's pipeline says of two frames a quarter of a metre apart."""
    seen = corridor_view((0.0, 0.0, 0.0))
    detector, camera = DetectorConfig(method="paper", baseline_m=0.25), CameraConfig(hfov_deg=75.0)
    pipeline = load_factory(f"companion.sim.rivals:{rival}")(detector, camera)
    said: list[str | tuple[float | None, float | None]] = []
    for seq, (image, north_m) in enumerate(((seen.earlier, 0.0), (seen.later, 0.25))):
        t_ns = seq * 200_000_000
        report = pipeline.detect(Frame(image, t_ns, seq), Pose(t_ns, north_m, 0.0, -1.3, NORTH))
        said.append(report.reason if report.kind == "none" else (report.x_px, report.y_px))
        if report.kind != "none":
            assert report.bearings, "the ways are measured as for the paper's method"
            assert report.ray_body is not None
    return said


def test_each_rival_has_a_pipeline_of_its_name():
    assert set(RIVALS) == {"straight", "flow_balance", "line_vp"}
    for rival in RIVALS:
        assert callable(getattr(rivals, rival))


def test_straight_ahead_is_the_middle_of_the_picture_once_there_is_a_pair():
    first, second = reports("straight")
    assert first == "no_earlier_frame"
    assert second == pytest.approx(((CAMERA.width_px - 1) / 2, (CAMERA.height_px - 1) / 2))


def test_flow_is_balanced_in_the_middle_of_a_corridor():
    _, second = reports("flow_balance")
    middle = np.array([(CAMERA.width_px - 1) / 2, (CAMERA.height_px - 1) / 2])
    assert np.linalg.norm(np.array(second) - middle) < 60.0


def test_a_picture_without_lines_is_no_direction():
    assert reports("line_vp")[1] == "nothing_known"


def test_an_unusable_frame_has_its_own_reason():
    detector, camera = DetectorConfig(method="paper"), CameraConfig(hfov_deg=75.0)
    pipeline = rivals.straight(detector, camera)
    black = np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8)
    said = [
        pipeline.detect(Frame(black, t, seq), Pose(t, 0.3 * seq, 0.0, -1.3, NORTH)).reason
        for seq, t in enumerate((0, 200_000_000))
    ]
    assert said[1] == "black"


@pytest.mark.parametrize("rival", RIVALS)
def test_the_services_configuration_does_not_know_them(rival: str):
    with pytest.raises(ValidationError, match="paper"):
        Config.model_validate({"detector": {"method": rival}})


def test_they_fly_in_simulated_time_only(capsys):
    with pytest.raises(FlightError, match="simulated time only"):
        FlightSpec(method="straight", realtime=True)
    assert main(["sim", "--world", "room", "--method", "line_vp", "--realtime"]) != 0
    assert "simulated time only" in capsys.readouterr().err


def test_a_rival_flies_through_the_real_service():
    spec = FlightSpec(method="straight", width_px=160, height_px=120, time_limit_s=3.0)
    result = judged(spec, ROOM, fly(spec, ROOM))
    assert (result.method, result.collisions) == ("straight", 0)
    assert set(result.answers) <= {"lowest_flow", "none"}
    assert result.answers["lowest_flow"] >= 5


def test_a_worker_that_does_not_come_up_is_named_where_the_flight_ends(monkeypatch):
    broken = "tests.companion.vision.stub_pipelines:broken"
    monkeypatch.setattr("companion.sim.lockstep_flight.VOID_PIPELINE", broken)
    with pytest.raises(CompanionError, match="a fault of the program"):
        fly(FlightSpec(method="paper", width_px=160, height_px=120, time_limit_s=3.0), ROOM)
