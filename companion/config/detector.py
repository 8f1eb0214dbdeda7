"""``[detector]``: the detector in its worker process."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from companion.config.section import Disagreement, Section


class DetectorConfig(Section):
    """The detector in its worker process."""

    method: Annotated[
        Literal["paper", "parallax"],
        Field(
            description="paper: the published method (clusters of flow, lines). parallax: the void map: ranges from dense flow, swept by the vehicle's size, remembered, with a confidence. Where it is not set but preset or params_file is: paper."
        ),
    ] = "parallax"
    preset: Annotated[
        Literal["default", "paper"],
        Field(description="Parameter set of the method paper: default (measured best) or paper (literal)."),
    ] = "default"
    params_file: Annotated[
        str,
        Field(
            description="TOML file with parameters of the method that replace its own: of paper those of the preset, of parallax (method must be named then) those of detector/parallax/params.py. companion tune writes such files. Empty: none."
        ),
    ] = ""
    deadline_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="A pair that takes longer counts as hung: the worker is killed and restarted. Larger: a hang is noticed later; smaller: a slow answer costs a worker (s).",
        ),
    ] = 10.0
    start_timeout_s: Annotated[
        float,
        Field(
            gt=0,
            le=300,
            description="Time allowed for the worker to start (imports included). Larger: one that hangs at its start is noticed later (s).",
        ),
    ] = 60.0
    restart_delay_s: Annotated[
        float,
        Field(
            gt=0,
            le=60,
            description="First delay before a restart; doubles up to restart_delay_max_s. Larger: back later after a single failure (s).",
        ),
    ] = 0.2
    restart_delay_max_s: Annotated[
        float,
        Field(
            gt=0,
            le=600,
            description="Longest delay between restarts. Larger: less load of a worker that keeps failing, back later (s).",
        ),
    ] = 5.0
    vehicle_width_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Width swept along a direction to find its free distance, margins included (m). Larger: fewer ways count as free.",
        ),
    ] = 0.9
    vehicle_height_m: Annotated[
        float,
        Field(
            gt=0,
            le=5,
            description="Height swept likewise, margins included. Larger: more counts as being in the way (m).",
        ),
    ] = 0.6
    baseline_m: Annotated[
        float,
        Field(
            ge=0.02,
            le=2,
            description="Distance flown between the two frames of a pair that is aimed at (m); 0.4 to 1.8 times of it is taken. Larger: surer ranges, fewer tracks that survive.",
        ),
    ] = 0.25
    send_obstacle_distance: Annotated[
        bool,
        Field(
            description="Send the free distances as OBSTACLE_DISTANCE (72 bins about the nose, unknown ones as unknown), for the autopilot's own collision prevention. Needs poses, which give the scale."
        ),
    ] = False
    threads: Annotated[
        int,
        Field(
            ge=1,
            le=64,
            description="OpenCV and BLAS threads of the worker. Larger: answers sooner, less of the processor for the rest; leave one core to the service.",
        ),
    ] = 1

    @model_validator(mode="before")
    @classmethod
    def _take_paper_for_its_settings(cls, table: Any) -> Any:
        """Take the method paper where only its settings are named: they must not be without effect."""
        if (
            isinstance(table, dict)
            and "method" not in table
            and ("preset" in table or table.get("params_file"))
        ):
            return {**table, "method": "paper"}
        return table

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if self.restart_delay_s <= self.restart_delay_max_s:
            return ()
        return (
            Disagreement(
                "restart_delay_s",
                str(self.restart_delay_s),
                f"at most restart_delay_max_s, which is {self.restart_delay_max_s}",
            ),
        )
