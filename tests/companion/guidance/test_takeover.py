"""The table of takeover: which phase follows which, and what is asked for how often."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from companion.config.takeover import InterceptionConfig
from companion.guidance.mission_goal import MissionGoal, MissionItem, Place, place_of
from companion.guidance.takeover import STREAMING, Ask, Facts, Flown, Phase, Takeover, Way

SEC = 1_000_000_000
FREE = Facts(armed=True, engaged=True, flown=Flown.MISSION, way=Way.FREE, arrived=False, fault=None)
BLOCKED = replace(FREE, way=Way.BLOCKED)
OURS = replace(BLOCKED, flown=Flown.SETPOINTS)
OURS_FREE = replace(OURS, way=Way.FREE)


class Run:
    """Steps the table at 20 Hz."""

    def __init__(self, **config) -> None:
        self.table = Takeover(InterceptionConfig(**config))
        self.now = SEC
        self.asked: list[Ask] = []

    def go(self, facts: Facts, seconds: float = 0.05) -> Phase:
        for _ in range(max(1, round(seconds * 20))):
            ask = self.table.step(facts, self.now)
            if ask is not None:
                self.asked.append(ask)
            self.now += SEC // 20
        return self.table.phase


def flying() -> Run:
    run = Run()
    run.go(FREE, 1)
    assert run.go(BLOCKED, 1.2) is Phase.ASKING
    assert run.go(OURS) is Phase.FLYING
    assert run.asked == [Ask.SETPOINTS]
    return run


def test_the_mode_is_asked_for_once_after_a_second_of_stream():
    run = Run()
    assert run.go(FREE, 2) is Phase.WATCHING
    assert not run.table.streams
    run.go(BLOCKED)
    assert run.table.streams
    assert run.go(BLOCKED, 0.9) is Phase.PREPARING
    assert run.asked == []
    assert run.go(BLOCKED, 0.2) is Phase.ASKING
    run.go(BLOCKED, 10)
    assert run.asked == [Ask.SETPOINTS]
    assert (run.table.phase, run.table.reason) == (Phase.OUT, "the mode was not taken")
    assert not run.table.streams


def test_a_flicker_between_two_answers_takes_nothing_over_and_does_not_restart_the_second():
    run = Run()
    run.go(FREE, 1)
    run.go(BLOCKED, 0.5)
    run.go(FREE, 0.3)
    assert run.go(BLOCKED, 0.5) is Phase.ASKING
    run = Run()
    run.go(FREE, 1)
    run.go(BLOCKED, 0.5)
    assert run.go(FREE, 0.7) is Phase.WATCHING
    assert run.asked == []


def test_the_mission_is_given_back_once_when_the_way_is_free_and_the_stream_lasts_until_the_mode_is_left():
    run = flying()
    assert run.go(OURS_FREE, 1.8) is Phase.FLYING
    assert run.go(OURS, 0.1) is Phase.FLYING
    assert run.go(OURS_FREE, 2.2) is Phase.RETURNING
    assert run.table.streams
    assert run.go(FREE) is Phase.WATCHING
    assert not run.table.streams
    assert run.asked == [Ask.SETPOINTS, Ask.MISSION]


def test_takeovers_soon_after_one_another_last_longer():
    run = flying()
    run.go(OURS_FREE, 2.2)
    run.go(FREE, 0.5)
    run.go(BLOCKED, 1.2)
    run.go(OURS)
    assert run.go(OURS_FREE, 3.5) is Phase.FLYING
    assert run.go(OURS_FREE, 1) is Phase.RETURNING


def test_the_pilot_wins_from_every_phase_and_nothing_is_asked_again():
    pilot = replace(BLOCKED, flown=Flown.OTHER)
    for facts in (pilot, BLOCKED):  # another mode; or the mission, which was not asked for
        run = flying()
        assert run.go(facts) is Phase.OUT
        assert run.go(BLOCKED, 20) is Phase.OUT
        assert run.go(OURS, 20) is Phase.OUT
        assert run.asked == [Ask.SETPOINTS]
        assert not run.table.streams
    run = Run()
    run.go(FREE, 1)
    run.go(BLOCKED, 0.5)
    assert run.go(pilot) is Phase.OUT
    run = flying()
    run.go(OURS_FREE, 2.2)
    assert run.go(pilot) is Phase.OUT


def test_after_out_it_takes_part_again_when_engaged_anew_or_armed_anew():
    for between in (replace(FREE, engaged=False), replace(FREE, armed=False)):
        run = flying()
        run.go(replace(FREE, flown=Flown.OTHER))
        run.go(between)
        assert run.go(FREE, 0.2) is Phase.WATCHING


def test_a_failure_asks_for_the_autopilots_hold_once_and_ends_our_part():
    run = flying()
    lost = replace(OURS, fault="vision silent")
    assert run.go(lost, 0.4) is Phase.FLYING
    assert run.go(OURS, 0.1) is Phase.FLYING
    assert run.go(lost, 0.6) is Phase.HOLDING
    assert run.table.streams
    assert run.go(lost, 2.2) is Phase.OUT
    assert not run.table.streams
    assert run.asked == [Ask.SETPOINTS, Ask.HOLD]


def test_nothing_is_taken_over_with_an_input_missing():
    run = Run()
    run.go(FREE, 1)
    assert run.go(replace(BLOCKED, fault="no goal of the mission"), 5) is Phase.WATCHING
    assert run.asked == []


def test_who_lets_go_while_we_fly_gets_the_mission_back():
    run = flying()
    assert run.go(replace(OURS, engaged=False)) is Phase.RETURNING
    assert run.go(replace(FREE, engaged=False), 0.1) is Phase.IDLE
    assert run.asked == [Ask.SETPOINTS, Ask.MISSION]


FACTS = st.builds(
    Facts,
    armed=st.sampled_from([True, True, True, False]),
    engaged=st.sampled_from([True, True, True, False]),
    flown=st.sampled_from(Flown),
    way=st.sampled_from(Way),
    arrived=st.booleans(),
    fault=st.sampled_from([None, None, "vision silent"]),
)


@given(st.lists(st.tuples(FACTS, st.floats(0.05, 3.0)), max_size=30))
def test_setpoints_are_never_sent_over_a_mode_of_somebody_elses(history):
    run = Run()
    for facts, seconds in history:
        phase = run.go(facts, seconds)
        if facts.flown is Flown.OTHER or not facts.armed:
            assert phase not in STREAMING
        if facts.flown is Flown.SETPOINTS and phase in STREAMING:
            assert Ask.SETPOINTS in run.asked


def item(seq: int, **changes) -> MissionItem:
    return MissionItem(
        **{"seq": seq, "frame": 6, "command": 16, "lat_int": 4, "lon_int": 5, "alt_m": 3.0, **changes}
    )


def test_a_mission_items_goal_is_as_old_as_the_last_word_of_it():
    goal = MissionGoal(InterceptionConfig())
    goal.on_items({0: item(0), 1: item(1, command=21)})
    assert goal.place(0, in_mission=True) == "no goal of the mission"
    goal.on_current(0, 0)
    assert goal.place(2 * SEC, in_mission=False) == Place(4, 5, 3.0, relative=True)
    assert goal.place(4 * SEC, in_mission=False) == "goal too old"
    goal.on_current(1, 4 * SEC)
    assert goal.place(4 * SEC, in_mission=False) == "mission item is no waypoint"


def test_the_autopilots_own_target_counts_in_its_mission_only_and_is_kept_for_a_while():
    goal = MissionGoal(InterceptionConfig(latched_goal_max_age_s=10.0))
    there, ours = Place(7, 8, 490.0, relative=False), Place(1, 1, 1.0, relative=False)
    goal.on_target(there, 0, in_mission=True)
    goal.on_target(ours, SEC, in_mission=False)
    assert goal.place(SEC, in_mission=True) == there
    assert isinstance(goal.place(4 * SEC, in_mission=True), str)
    assert goal.place(9 * SEC, in_mission=False) == there
    assert isinstance(goal.place(11 * SEC, in_mission=False), str)
    goal.on_current(0, 0)
    goal.on_current(1, SEC)  # the next item: what was the target of the one before is none
    assert isinstance(goal.place(SEC, in_mission=True), str)


def test_heights_above_terrain_and_what_is_no_number_are_no_goal():
    assert place_of(item(0)) is not None
    assert place_of(item(0, frame=11)) is None
    assert place_of(item(0, alt_m=float("nan"))) is None
    assert place_of(item(0, lat_int=0, lon_int=0)) is None
