"""The world of a suite's flight, on whichever machine it is flown."""

from __future__ import annotations

from typing import cast

from companion.sim.suite import PlannedFlight
from companion.sim.world.file import load_world, parse_world
from companion.sim.world.model import World
from companion.sim.world.random import Difficulty, random_world


def world_of(flight: PlannedFlight) -> World:
    """Return the world that a flight is flown in.

    Raises
    ------
    companion.errors.ConfigError
        When there is no such world, or its file's text cannot be used.
    """
    spec = flight.spec
    if flight.world_toml is not None:
        return parse_world(flight.world_toml, name=spec.world)
    if spec.world == "random":
        return random_world(spec.seed, cast(Difficulty, spec.difficulty))  # which it checks
    return load_world(spec.world)
