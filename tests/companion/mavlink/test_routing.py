"""Routing by MAVLink's rules, and the filters of links."""

import pytest
from pymavlink.dialects.v20 import common

from companion.config.link_filter import parse_filter_rule
from companion.mavlink.endpoint import LinkCounters
from companion.mavlink.framing import Framer
from companion.mavlink.network import Network
from companion.mavlink.routing import LinkPlace, Router, target_of

PLACES = [LinkPlace("planner.1", False), LinkPlace("planner.2", False), LinkPlace("autopilot", True)]


def frame(message, system=255, component=190, *, v1=False):
    packed = bytes(message.pack(common.MAVLink(None, system, component), force_mavlink1=v1))
    (got,) = Framer().feed(packed)
    return got


def heartbeat(system, component):
    return frame(common.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), system, component)


def command(target, system=255, component=190, *, v1=False):
    message = common.MAVLink_command_long_message(*target, 400, 0, 0, 0, 0, 0, 0, 0, 0)
    return frame(message, system, component, v1=v1)


def setpoint(target, system=255):
    return frame(
        common.MAVLink_set_position_target_local_ned_message(
            0, *target, 1, 3576, 1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0
        ),
        system,
    )


def links_of(mask):
    return {i for i in range(8) if mask >> i & 1}


@pytest.mark.parametrize("v1", [False, True])
def test_targets_are_read_as_pymavlink_packs_them(v1):
    for message_id, message in common.mavlink_map.items():
        if "target_system" not in message.fieldnames or (v1 and message_id > 255):
            continue
        values = {
            name: ([1] * length if kind != "char" else b"x")
            if (length := message.array_lengths[message.ordered_fieldnames.index(name)])
            else (b"x" if kind == "char" else 1)
            for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True)
        }
        values["target_system"] = 77
        if "target_component" in values:
            values["target_component"] = 88
        got = frame(message(**values), v1=v1)
        assert target_of(got) == (77, 88 if "target_component" in values else 0), message.msgname


def test_trimmed_targets_are_broadcast():
    assert target_of(command((0, 0))) == (0, 0)
    assert target_of(heartbeat(1, 1)) == (0, 0)


def test_broadcasts_go_everywhere_but_back():
    router = Router(PLACES)
    assert links_of(router.destinations(0, heartbeat(255, 190))) == {1, 2}
    assert links_of(router.destinations(2, heartbeat(1, 1))) == {0, 1}
    assert links_of(router.destinations(1, command((0, 0)))) == {0, 2}


def test_targeted_frames_go_where_the_target_was_heard_and_nowhere_else():
    router = Router(PLACES)
    assert router.destinations(0, command((1, 1))) == 0
    router.learn(2, heartbeat(1, 1))
    router.learn(1, heartbeat(245, 1))
    assert links_of(router.destinations(0, command((1, 1)))) == {2}
    assert links_of(router.destinations(2, command((245, 1), 1, 1))) == {1}
    assert links_of(router.destinations(0, command((245, 1)))) == {1}
    assert router.destinations(1, command((245, 1))) == 0  # never back
    assert links_of(router.destinations(0, command((1, 0)))) == {2}


def test_within_our_own_system_a_component_must_have_been_heard():
    router = Router(PLACES)
    router.learn(2, heartbeat(1, 1))
    assert links_of(router.destinations(0, command((1, 154)))) == {2}  # another system: the system decides
    router.own_system_id = 1
    assert router.destinations(0, command((1, 154))) == 0
    router.learn(2, heartbeat(1, 154))
    assert links_of(router.destinations(0, command((1, 154)))) == {2}


def test_a_setpoint_never_goes_round_the_interception():
    places = [*PLACES, LinkPlace("autopilot.2", True)]
    router = Router(places)
    for link in range(4):
        router.learn(link, heartbeat(1, 1))
    assert links_of(router.destinations(0, setpoint((1, 1)))) == {2, 3}
    assert links_of(router.destinations(2, setpoint((0, 0)))) == {0, 1}
    assert links_of(router.destinations(2, setpoint((1, 1)))) == {0, 1}


def test_two_links_to_one_autopilot_do_not_play_its_telemetry_back_to_it():
    router = Router(
        [LinkPlace("planner", False), LinkPlace("autopilot.1", True), LinkPlace("autopilot.2", True)]
    )
    router.learn(1, heartbeat(1, 1))
    router.learn(2, heartbeat(1, 1))
    assert links_of(router.destinations(1, heartbeat(1, 1))) == {0}


def test_one_link_a_side_is_a_wire():
    router = Router([LinkPlace("planner", False), LinkPlace("autopilot", True)])
    assert links_of(router.destinations(0, command((9, 9)))) == {1}
    assert links_of(router.destinations(1, command((9, 9)))) == {0}


def test_what_no_checksum_vouches_for_names_no_link():
    router = Router(PLACES)
    router.learn(2, heartbeat(9, 9)._replace(verified=False))
    assert router.destinations(0, command((9, 9))) == 0


class Wire:
    def __init__(self):
        self.on_frames, self.counters, self.sent = None, LinkCounters(), []

    def send(self, datagram):
        self.sent.append(datagram)
        return 1


def plain_network(planner, autopilot, filters=()):
    """A network that forwards all that it is given."""

    def treat(link, frames):
        network.forward(link, frames)

    network = Network(planner, autopilot, treat, filters=filters)
    return network


def test_filters_keep_frames_back_both_ways_and_are_counted():
    rules = [
        parse_filter_rule("deny in planner.1 system=200-254 message=76"),
        parse_filter_rule("deny out planner.2 component=1 message=0,30-32"),
        parse_filter_rule("allow out planner.1 message=0"),
    ]
    planner1, planner2, autopilot = Wire(), Wire(), Wire()
    network = plain_network([planner1, planner2], [autopilot], rules)
    beat, attitude = heartbeat(1, 1), frame(common.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 1), 1, 1)
    other = frame(common.MAVLink_system_time_message(1, 2), 1, 1)
    autopilot.on_frames([beat, attitude, other])
    assert planner1.sent == [beat.data]  # its allow rule denies the rest
    assert planner2.sent == [other.data]
    assert (planner1.counters.filtered_frames, planner2.counters.filtered_frames) == (2, 2)
    planner1.on_frames([command((1, 1), 245), command((1, 1), 255)])
    assert autopilot.sent == [command((1, 1), 255).data]
    assert planner1.counters.filtered_frames == 3
    assert network.unrouted_frames == 1  # ATTITUDE, which nobody was let have


def test_frames_of_one_way_leave_as_one_datagram_and_in_order():
    links = [Wire(), Wire(), Wire()]
    plain_network(links[:2], links[2:])
    links[2].on_frames([heartbeat(1, 1)])
    a, b, c = heartbeat(255, 190), command((1, 1)), heartbeat(255, 190)
    links[0].on_frames([a, b, b, c])
    assert links[2].sent == [a.data, b.data + b.data, c.data]
    assert links[0].sent[1:] == []


@pytest.mark.parametrize(
    "rule",
    [
        "",
        "deny",
        "deny planner",
        "drop in planner",
        "deny in engine",
        "deny in planner.0",
        "deny in * message=5-3",
        "deny in * system=256",
        "deny in * message=1 message=2",
        "deny in * colour=3",
        "deny in * message=",
    ],
)
def test_a_rule_that_cannot_be_read_is_a_clear_error(rule):
    with pytest.raises(ValueError, match=r"allow or deny|ids from 0"):
        parse_filter_rule(rule)


def test_rules_concern_links_by_name():
    assert parse_filter_rule("deny in planner").concerns("planner.2")
    assert parse_filter_rule("deny in planner.2").concerns("planner.2")
    assert not parse_filter_rule("deny in planner.2").concerns("planner.1")
    assert parse_filter_rule("deny in *").concerns("autopilot")
