"""The world of a suite's flight, on whichever machine it is flown."""

from __future__ import annotations

from companion.sim.flight_worlds import find_world
from companion.sim.suite import PlannedFlight
from companion.sim.world.file import parse_world
from companion.sim.world.model import World


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
    return find_world(spec.world, seed=spec.seed, difficulty=spec.difficulty)
