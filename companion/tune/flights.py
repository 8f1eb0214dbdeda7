"""Simulated flights as cases: collisions first, then time."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.config_file import config_of, toml_value
from companion.errors import CompanionError
from companion.sim.flight import FlightSpec
from companion.sim.flight_worlds import place_in
from companion.sim.suite import FlyAll, PlannedFlight, plan_flights
from companion.sim.suite_worlds import world_of
from companion.tune.cases import Part, held_out_count
from companion.tune.errors import TrialError, TuneError
from companion.tune.score import flight_scores
from companion.tune.space import Settings

PARAMS_FILE: Final = "params.toml"


class Flights:
    """Every world with every seed; the last seeds are held out.

    Parameters
    ----------
    worlds
        As ``companion sim suite --worlds`` takes them.
    seeds
        At least one.
    template
        The rest of each flight, its method included.
    hold_out
        Share of the seeds.
    fly_all
        Flies them.

    Raises
    ------
    companion.errors.CompanionError
        A world cannot be used.
    """

    def __init__(
        self,
        worlds: Sequence[str],
        seeds: Sequence[int],
        template: FlightSpec,
        *,
        hold_out: float,
        fly_all: Callable[[], FlyAll],
    ) -> None:
        if template.method == "off":
            raise TuneError("flights without the service have no settings to search")
        first_held = len(seeds) - held_out_count(len(seeds), hold_out)
        self._planned: dict[Part, tuple[PlannedFlight, ...]] = {
            "searched": plan_flights(worlds, seeds[:first_held], (template.method,), template),
            "held_out": (
                plan_flights(worlds, seeds[first_held:], (template.method,), template)
                if seeds[first_held:]
                else ()
            ),
        }
        self._limits_s: dict[str, float] = {}
        self._reachable: dict[str, bool] = {}
        for flight in (*self._planned["searched"], *self._planned["held_out"]):
            world = world_of(flight)
            self._limits_s[flight.name] = flight.spec.rules_for(place_in(world)).time_limit_s
            self._reachable[flight.name] = world.goal_reachable
        self._fly_all, self._template = fly_all, template

    def count(self, part: Part) -> int:
        """Return how many flights there are."""
        return len(self._planned[part])

    def scores(
        self, settings: Settings, part: Part, on_case: Callable[[], None] = lambda: None
    ) -> NDArray[np.float64]:
        """Fly them all (:func:`companion.tune.score.flight_scores`).

        Raises
        ------
        TrialError
            The configuration does not allow these settings together, or a simulation failed.
        """
        with tempfile.TemporaryDirectory(prefix="tune-") as name:
            tables = tables_with(settings, Path(name), self._template)
            try:
                config_of(tables, name="settings")
            except CompanionError as error:
                raise TrialError(" ".join(str(error).split())) from error
            flights = [
                dataclasses.replace(flight, spec=dataclasses.replace(flight.spec, settings=tables))
                for flight in self._planned[part]
            ]
            outcomes: dict[str, tuple[str, float]] = {}
            with closing(self._fly_all()(flights)) as flown:
                for flight, ending in flown:
                    if ending.result is None:
                        raise TrialError(f"{flight.name}: {ending.error}")
                    outcomes[flight.name] = (
                        str(ending.result["outcome"]),
                        float(ending.result["time_s"]),
                    )
                    on_case()
        names = [flight.name for flight in self._planned[part]]
        return flight_scores(
            [outcomes[name][0] for name in names],
            [outcomes[name][1] for name in names],
            [self._limits_s[name] for name in names],
            reachable=[self._reachable[name] for name in names],
        )

    def about(self) -> dict[str, Any]:
        """Return which flights these are."""
        return {
            part: [flight.as_dict() for flight in self._planned[part]] for part in ("searched", "held_out")
        }


def tables_with(settings: Settings, folder: Path, template: FlightSpec) -> dict[str, dict[str, Any]]:
    """Return settings as tables of the configuration, over those of the flights.

    Parameters
    ----------
    settings
        What is tried.
    folder
        The method's own parameters go into a file in there.
    template
        Of the flights: its method and settings.
    """
    tables: dict[str, dict[str, Any]] = {"detector": {"method": template.method}}
    for name, table in template.settings.items():
        tables.setdefault(name, {}).update(table)
    params = {name: value for name, value in settings.items() if "." not in name}
    for name, value in settings.items():
        table_name, dot, key = name.partition(".")
        if dot:
            tables.setdefault(table_name, {})[key] = value
    if params:
        file = folder / PARAMS_FILE
        file.write_text(params_toml(params), encoding="utf-8")
        tables["detector"]["params_file"] = str(file)
    return tables


def params_toml(params: Settings) -> str:
    """Return a file of a method's parameters."""
    return "".join(f"{name} = {toml_value(value)}\n" for name, value in params.items())
