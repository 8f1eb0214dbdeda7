from companion.web.outgoing import Outgoing
from companion.web.state import KEPT, Increment


def test_a_viewer_that_takes_nothing_keeps_only_the_newest() -> None:
    outgoing = Outgoing()
    for number in range(5000):
        outgoing.add(Increment({"pose": number}, {"log": [f"line {number}"], "trail": [[number, 0]]}))
        outgoing.add_picture(b"%d" % number)
    message, picture = outgoing.take()
    assert message is not None
    assert picture == b"4999"
    assert message["latest"] == {"pose": 4999}
    assert message["appended"]["log"] == [f"line {number}" for number in range(5000 - KEPT["log"], 5000)]
    assert len(message["appended"]["trail"]) == KEPT["trail"]
    assert message["missed"]["log"] == 5000 - KEPT["log"]
    assert outgoing.pictures_replaced == 4999
    assert not outgoing.has_any()


def test_no_third_picture_goes_out_before_one_was_shown() -> None:
    outgoing = Outgoing()
    sent = []
    for number in range(5):
        outgoing.add_picture(b"%d" % number)
        if outgoing.has_any():
            sent.append(outgoing.take()[1])
    assert sent == [b"0", b"1"]
    outgoing.shown()
    assert outgoing.has_any()
    assert outgoing.take()[1] == b"4"


def test_who_comes_gets_a_snapshot_first_and_then_what_is_new() -> None:
    outgoing = Outgoing()
    outgoing.add(Increment({"pose": 1}, {}))
    outgoing.begin(Increment({"pose": 2}, {"log": ["a"]}))
    outgoing.add(Increment({"pose": 3}, {"log": ["b"]}))
    first, _ = outgoing.take()
    second, _ = outgoing.take()
    assert first == {"type": "snapshot", "latest": {"pose": 2}, "appended": {"log": ["a"]}}
    assert second == {"type": "update", "latest": {"pose": 3}, "appended": {"log": ["b"]}}


def test_an_empty_snapshot_is_sent_too() -> None:
    outgoing = Outgoing()
    outgoing.begin(Increment())
    assert outgoing.has_any()
    assert outgoing.take()[0] == {"type": "snapshot", "latest": {}, "appended": {}}
