"""Suites: which flights, what is kept, what a second start flies, and what the report says of it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from companion.sim.flight import FlightSpec
from companion.sim.suite import (
    FAILED_SIMULATION,
    Ending,
    Endings,
    Finished,
    PlannedFlight,
    SuiteError,
    plan_flights,
    run_suite,
)
from companion.sim.suite_report import report_json, report_markdown, rows_of

TEMPLATE = FlightSpec(time_limit_s=30.0)


def result_of(flight: PlannedFlight, outcome: str = "reached", **figures: float | None) -> dict[str, object]:
    return {
        "world": flight.spec.world,
        "seed": flight.spec.seed,
        "method": flight.spec.method,
        "outcome": outcome,
        "time_s": 10.0,
        "path_m": 5.0,
        "min_clearance_m": 0.5,
        "free_ratio_median": 0.8,
        "decisions": 50,
        **figures,
    }


def good(flight: PlannedFlight) -> Ending:
    return Ending(result=result_of(flight), succeeded=True, record=b"a record")


class Flyer:
    """Gives each flight an ending made here, and remembers which were asked for."""

    def __init__(self, ending=good) -> None:
        self.ending = ending
        self.flown: list[str] = []
        self.closed = False

    def __call__(self, flights: Sequence[PlannedFlight]) -> Endings:
        try:
            for flight in reversed(flights):  # not in their order
                self.flown.append(flight.name)
                yield flight, self.ending(flight)
        finally:
            self.closed = True


def two_by_two() -> tuple[PlannedFlight, ...]:
    return plan_flights(["room", "random"], [3, 4], ["paper"], TEMPLATE)


# ---- which flights


def test_every_world_flies_with_every_seed_and_method():
    flights = plan_flights(["room", "random"], [1, 2], ["paper", "off"], TEMPLATE)
    assert [flight.name for flight in flights] == [
        "room-s1-paper",
        "room-s1-off",
        "room-s2-paper",
        "room-s2-off",
        "random-medium-s1-paper",
        "random-medium-s1-off",
        "random-medium-s2-paper",
        "random-medium-s2-off",
    ]
    assert flights[3].spec == dataclasses.replace(TEMPLATE, world="room", seed=2, method="off")


def test_a_world_file_travels_as_text(tmp_path):
    file = tmp_path / "hall.toml"
    file.write_text("name = 'hall'")
    (flight,) = plan_flights([str(file)], [1], ["off"], TEMPLATE)
    assert (flight.name, flight.spec.world, flight.world_toml) == (
        "hall-s1-off",
        "hall.toml",
        "name = 'hall'",
    )
    assert PlannedFlight.from_dict(json.loads(json.dumps(flight.as_dict()))) == flight


def test_a_world_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SuiteError, match=r"nowhere\.toml: no such file"):
        plan_flights([str(tmp_path / "nowhere.toml")], [1], ["off"], TEMPLATE)


@pytest.mark.parametrize(
    ("worlds", "seeds", "methods"),
    [(["room", "room"], [1], ["off"]), (["room"], [1, 1], ["off"]), (["room"], [1], ["off", "off"])],
)
def test_the_same_flight_twice_is_refused(worlds, seeds, methods):
    with pytest.raises(SuiteError, match="room-s1-off is asked for twice"):
        plan_flights(worlds, seeds, methods, TEMPLATE)


def test_no_flights_are_refused():
    with pytest.raises(SuiteError, match="at least one"):
        plan_flights([], [1], ["off"], TEMPLATE)


# ---- what is kept


def test_endings_come_back_in_the_order_of_the_suite_with_their_files(tmp_path):
    told: list[Finished] = []
    finished = run_suite(two_by_two(), tmp_path / "new" / "suite", Flyer(), told.append)
    assert [flight.flight for flight in finished] == list(two_by_two())
    assert {flight.flight.name for flight in told} == {flight.name for flight in two_by_two()}
    assert all(flight.outcome == "reached" and flight.succeeded for flight in finished)
    assert finished[0].record is not None
    assert finished[0].record.read_bytes() == b"a record"
    assert finished[0].video is None


def test_a_second_start_flies_nothing_and_answers_the_same(tmp_path):
    first = run_suite(two_by_two(), tmp_path, Flyer())
    again = Flyer()
    assert run_suite(two_by_two(), tmp_path, again) == first
    assert again.flown == []


def test_an_interrupted_suite_goes_on_where_it_was(tmp_path):
    flights = two_by_two()

    def interrupt_after_two(finished: Finished) -> None:
        if len(list((tmp_path / "flights").glob("*.json"))) == 2:
            raise KeyboardInterrupt

    first, second = Flyer(), Flyer()
    with pytest.raises(KeyboardInterrupt):
        run_suite(flights, tmp_path, first, interrupt_after_two)
    assert first.closed  # what flies must end
    run_suite(flights, tmp_path, second)
    assert sorted(first.flown + second.flown) == sorted(flight.name for flight in flights)


def test_a_suite_can_grow(tmp_path):
    run_suite(two_by_two(), tmp_path, Flyer())
    more = Flyer()
    finished = run_suite(plan_flights(["random"], [4, 5], ["paper"], TEMPLATE), tmp_path, more)
    assert more.flown == ["random-medium-s5-paper"]
    assert len(finished) == 2


def test_a_failed_simulation_is_recorded_and_tried_again(tmp_path):
    (flight,) = flights = plan_flights(["room"], [1], ["off"], TEMPLATE)
    broken = Flyer(lambda _: Ending(error="the simulation was ended by SIGSEGV", log="last words"))
    (finished,) = run_suite(flights, tmp_path, broken)
    assert (finished.outcome, finished.result, finished.succeeded) == (FAILED_SIMULATION, None, False)
    log = tmp_path / "flights" / f"{flight.name}.log"
    assert log.read_text() == "last words"
    kept = json.loads((tmp_path / "flights" / f"{flight.name}.json").read_text())
    assert kept["error"] == "the simulation was ended by SIGSEGV"

    mended = Flyer()
    (finished,) = run_suite(flights, tmp_path, mended)
    assert mended.flown == [flight.name]
    assert finished.outcome == "reached"
    assert not log.exists()


def test_a_folder_of_other_flights_is_refused(tmp_path):
    run_suite(plan_flights(["room"], [1], ["off"], TEMPLATE), tmp_path, Flyer())
    other = plan_flights(["room"], [1], ["off"], dataclasses.replace(TEMPLATE, width_px=640))
    with pytest.raises(SuiteError, match=r"room-s1-off\.json: was flown with other settings"):
        run_suite(other, tmp_path, Flyer())


def test_a_world_file_that_changed_is_another_flight(tmp_path):
    file = tmp_path / "hall.toml"
    file.write_text("name = 'hall'")
    run_suite(plan_flights([str(file)], [1], ["off"], TEMPLATE), tmp_path, Flyer())
    file.write_text("name = 'hall'\n# changed")
    with pytest.raises(SuiteError, match="other settings"):
        run_suite(plan_flights([str(file)], [1], ["off"], TEMPLATE), tmp_path, Flyer())


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", '{"flight": {"name": 1, "spec": {"a": 1}, "world_toml": 2}}']
)
def test_a_file_that_is_no_flight_is_named(tmp_path, text):
    flights = plan_flights(["room"], [1], ["off"], TEMPLATE)
    (tmp_path / "flights").mkdir()
    (tmp_path / "flights" / "room-s1-off.json").write_text(text)
    with pytest.raises(SuiteError, match=r"room-s1-off\.json: not a flight"):
        run_suite(flights, tmp_path, Flyer())


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SuiteError, match="cannot be made a suite's folder"):
        run_suite(two_by_two(), tmp_path / "file", Flyer())


# ---- the report


def mixed(tmp_path: Path) -> tuple[Finished, ...]:
    def ending(flight: PlannedFlight) -> Ending:
        match flight.spec.seed, flight.spec.method:
            case 1, "paper":
                return Ending(result_of(flight, time_s=8.0, min_clearance_m=0.4), succeeded=True)
            case 2, "paper":
                return Ending(result_of(flight, time_s=12.0, min_clearance_m=0.3), succeeded=True)
            case 1, "off":
                figures = {"min_clearance_m": -0.01, "free_ratio_median": None}
                return Ending(result_of(flight, "collided", **figures), video=b"a video")
        return Ending(error="it | fell over")

    return run_suite(
        plan_flights(["door", "random"], [1, 2], ["paper", "off"], TEMPLATE), tmp_path, Flyer(ending)
    )


def test_rows_count_outcomes_by_world_and_method_and_over_all_worlds(tmp_path):
    rows = {(row.world, row.method): row for row in rows_of(mixed(tmp_path))}
    assert list(rows) == [
        ("door", "paper"),
        ("door", "off"),
        ("random medium", "paper"),
        ("random medium", "off"),
        ("all", "paper"),
        ("all", "off"),
    ]
    paper, off = rows["door", "paper"], rows["all", "off"]
    assert (paper.flights, paper.outcomes, paper.succeeded) == (2, (2, 0, 0, 0, 0), 2)
    assert (paper.min_clearance_m, paper.time_s, paper.path_m, paper.free_ratio) == (0.3, 10.0, 5.0, 0.8)
    assert (off.flights, off.outcomes, off.succeeded) == (4, (0, 2, 0, 0, 2), 0)
    assert (off.min_clearance_m, off.time_s, off.free_ratio) == (-0.01, None, None)


def test_the_json_report_has_every_flight(tmp_path):
    report = json.loads(report_json(mixed(tmp_path), tmp_path))
    assert len(report["flights"]) == 8
    by_name = {flight["name"]: flight for flight in report["flights"]}
    assert by_name["door-s1-off"]["video"] == "flights/door-s1-off.mp4"
    assert by_name["door-s2-off"]["error"] == "it | fell over"
    assert by_name["door-s1-paper"]["result"]["time_s"] == 8.0
    assert report["summary"][0]["reached"] == 2
    assert report["summary"][-1]["failed_simulation"] == 2


def test_every_line_of_a_markdown_table_has_the_cells_of_its_head(tmp_path):
    text = report_markdown(mixed(tmp_path), tmp_path)
    for block in text.split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        assert len({line.replace("\\|", "").count("|") for line in lines}) <= 1
    assert "| door | paper | 2 | 2 | 0 | 0 | 0 | 0 | 2 | 0.30 | 10.0 | 5.0 | 0.80 |" in text
    assert "[video](flights/door-s1-off.mp4)" in text
    assert "- door-s2-off: it | fell over" in text


def test_a_report_of_one_world_has_no_row_for_all(tmp_path):
    finished = run_suite(plan_flights(["room"], [1, 2], ["paper"], TEMPLATE), tmp_path, Flyer())
    assert [row.world for row in rows_of(finished)] == ["room"]
