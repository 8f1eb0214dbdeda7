"""A world as data: what stands where, how it looks, where a flight begins and where it is to go.

Places are local NED, north and east in metres; heights are metres above the floor, which is at down = 0. Angles are
azimuths in degrees, clockwise from north as seen from above. One model a kind of thing; all frozen and strict.
"""

from __future__ import annotations

import math
from itertools import chain, pairwise
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from companion.config import Disagreement, DisagreementError
from companion.sim.world.furniture import FurnitureKind
from companion.sim.world.textures import checked_texture

Coordinate = Annotated[float, Field(ge=-200.0, le=200.0)]
Azimuth = Annotated[float, Field(ge=-360.0, le=360.0)]
Height = Annotated[float, Field(ge=0.0, le=50.0)]
Length = Annotated[float, Field(ge=0.01, le=400.0)]
Along = Annotated[
    float,
    Field(ge=0.0, le=400.0, description="Middle of it, along the wall from the wall's from_m."),
]
Texture = Annotated[
    str,
    AfterValidator(checked_texture),
    Field(examples=["brick_wall_1", "plain:#c0c0c0"]),
]
# A file has lists where the models have tuples; what is in them stays strict.
Point = Annotated[tuple[Coordinate, Coordinate], Field(strict=False, description="[north, east] (m).")]
Size = Annotated[
    tuple[Length, Length, Length],
    Field(strict=False, description="[along its heading, across it, height] (m)."),
]


class _Thing(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    def _disagreements(self) -> tuple[Disagreement, ...]:
        """Return what is wrong between keys that are right one by one."""
        return ()

    @model_validator(mode="after")
    def _check_between_keys(self) -> Self:
        if found := self._disagreements():
            raise DisagreementError(found)
        return self


class Opening(_Thing):
    """A doorway: a gap in a wall from the wall's foot up."""

    at_m: Along
    width_m: Length
    height_m: Annotated[Length, Field(description="From the wall's foot.")] = 2.1


class Picture(_Thing):
    """A picture, notice or closed door flat on a wall: it is looked at, and no obstacle. Stretched to its size."""

    at_m: Along
    side: Annotated[
        Literal["left", "right"], Field(description="Side of the wall, going from from_m to to_m.")
    ]
    bottom_m: Annotated[Height, Field(description="Its lower edge, above the floor.")] = 1.0
    width_m: Length = 0.8
    height_m: Length = 1.0
    texture: Texture


class Wall(_Thing):
    """A straight wall. Its middle line goes from from_m to to_m; half the thickness lies on each side."""

    from_m: Point
    to_m: Point
    thickness_m: Annotated[Length, Field(le=5)] = 0.15
    bottom_m: Annotated[Height, Field(description="Its foot, above the floor.")] = 0.0
    height_m: Annotated[Length | None, Field(description="From its foot; left out: up to the ceiling.")] = (
        None
    )
    texture: Texture = "drywall_1"
    openings: Annotated[
        tuple[Opening, ...], Field(strict=False, max_length=500, description="Doorways in it.")
    ] = ()
    pictures: Annotated[
        tuple[Picture, ...], Field(strict=False, max_length=500, description="Flat on it.")
    ] = ()

    @property
    def length_m(self) -> float:
        """From one end of the middle line to the other."""
        return math.dist(self.from_m, self.to_m)

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if self.length_m < 0.05:
            return (Disagreement("to_m", f"{self.length_m:g} m from from_m", "at least 0.05 m from it"),)
        keyed = chain(
            (
                (f"openings[{index}].at_m", opening.at_m, opening.width_m)
                for index, opening in enumerate(self.openings)
            ),
            (
                (f"pictures[{index}].at_m", picture.at_m, picture.width_m)
                for index, picture in enumerate(self.pictures)
            ),
        )
        faults = [
            Disagreement(
                key,
                f"{at_m:g} with width_m = {width_m:g}",
                f"within the wall's length of {self.length_m:.3f} m",
            )
            for key, at_m, width_m in keyed
            if at_m - width_m / 2 < -1e-6 or at_m + width_m / 2 > self.length_m + 1e-6
        ]
        ordered = sorted(self.openings, key=lambda opening: opening.at_m)
        faults.extend(
            Disagreement("openings", f"two that overlap, at_m = {a.at_m:g} and {b.at_m:g}", "openings apart")
            for a, b in pairwise(ordered)
            if a.at_m + a.width_m / 2 > b.at_m - b.width_m / 2
        )
        return tuple(faults)


class Box(_Thing):
    """A block: a cupboard, a table, a beam under the ceiling."""

    centre_m: Point
    size_m: Size
    yaw_deg: Annotated[Azimuth, Field(description="Azimuth of its length.")] = 0.0
    bottom_m: Annotated[Height, Field(description="Its underside, above the floor.")] = 0.0
    texture: Texture = "wood_1"


class Pillar(_Thing):
    """A round column on the floor."""

    centre_m: Point
    radius_m: Annotated[Length, Field(le=10)] = 0.2
    height_m: Annotated[Length | None, Field(description="Left out: up to the ceiling.")] = None
    texture: Texture = "concrete_1"


class Person(_Thing):
    """Somebody who stands still."""

    centre_m: Point
    height_m: Annotated[float, Field(ge=0.5, le=2.5)] = 1.75
    yaw_deg: Annotated[Azimuth, Field(description="Where they look.")] = 0.0
    clothes_texture: Texture = "plain:#35507a"

    @property
    def shoulders_m(self) -> tuple[float, float]:
        """Depth along their heading and width across it, of the whole figure."""
        return 0.17 * self.height_m, 0.29 * self.height_m


class Furniture(_Thing):
    """A mesh of the miniworld wheel, standing on the floor."""

    kind: FurnitureKind
    centre_m: Point
    yaw_deg: Annotated[Azimuth, Field(description="Its heading.")] = 0.0
    scale: Annotated[float, Field(ge=0.2, le=3.0, description="1 is life size.")] = 1.0


class Light(_Thing):
    """An even light, and one from a direction; there are no shadows."""

    ambient: Annotated[
        float, Field(ge=0.0, le=1.0, description="Part of the light that comes from everywhere.")
    ] = 0.6
    azimuth_deg: Annotated[Azimuth, Field(description="Where the other part comes from.")] = 30.0
    elevation_deg: Annotated[float, Field(ge=0.0, le=90.0, description="And how high up.")] = 60.0
    brightness: Annotated[
        float, Field(ge=0.05, le=2.0, description="Factor on everything; 1 is a lit office.")
    ] = 1.0


class Start(_Thing):
    """Where a flight begins."""

    north_m: Coordinate
    east_m: Coordinate
    height_m: Annotated[Height, Field(description="Of the vehicle's middle above the floor.")] = 1.2
    yaw_deg: Annotated[Azimuth, Field(description="First heading.")] = 0.0


class Goal(_Thing):
    """Where it is to go."""

    north_m: Coordinate
    east_m: Coordinate
    height_m: Annotated[Height, Field(description="Of the vehicle's middle above the floor.")] = 1.2


class World(_Thing):
    """Everything there is in a world."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    description: Annotated[str, Field(max_length=1000)] = ""
    ceiling_m: Annotated[float, Field(ge=1.0, le=50.0, description="Height of the ceiling.")] = 2.7
    floor_texture: Texture = "floor_tiles_white"
    ceiling_texture: Texture = "ceiling_tiles_1"
    start: Start
    goal: Goal
    goal_reachable: Annotated[
        bool, Field(description="false: nothing leads there, and to turn back is right.")
    ] = True
    reference_path_m: Annotated[
        tuple[Point, ...],
        Field(
            strict=False,
            max_length=500,
            description="Corners of a way that can be flown, start and goal among them; made worlds have one.",
        ),
    ] = ()
    time_limit_s: Annotated[float, Field(ge=5.0, le=3600.0, description="Then a flight is over.")] = 120.0
    light: Light = Light()
    walls: Annotated[tuple[Wall, ...], Field(strict=False, max_length=500)] = ()
    boxes: Annotated[tuple[Box, ...], Field(strict=False, max_length=500)] = ()
    pillars: Annotated[tuple[Pillar, ...], Field(strict=False, max_length=500)] = ()
    people: Annotated[tuple[Person, ...], Field(strict=False, max_length=500)] = ()
    furniture: Annotated[tuple[Furniture, ...], Field(strict=False, max_length=500)] = ()

    def _disagreements(self) -> tuple[Disagreement, ...]:
        if not self.walls:
            return (Disagreement("walls", "none", "at least one"),)
        ceiling_m = self.ceiling_m
        tops_m = {"start.height_m": self.start.height_m, "goal.height_m": self.goal.height_m}
        for index, wall in enumerate(self.walls):
            foot_m = wall.bottom_m
            tops_m[f"walls[{index}].bottom_m"] = foot_m + 0.01
            tops_m[f"walls[{index}].height_m"] = foot_m + (wall.height_m or 0.0)
        tops_m |= {f"boxes[{i}].size_m": box.bottom_m + box.size_m[2] for i, box in enumerate(self.boxes)}
        tops_m |= {f"pillars[{i}].height_m": pillar.height_m or 0.0 for i, pillar in enumerate(self.pillars)}
        tops_m |= {f"people[{i}].height_m": person.height_m for i, person in enumerate(self.people)}
        return tuple(
            Disagreement(key, f"a top at {top_m:g} m", f"below the ceiling, ceiling_m = {ceiling_m:g}")
            for key, top_m in tops_m.items()
            if top_m > ceiling_m + 1e-9
        )
