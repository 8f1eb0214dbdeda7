"""All links of both sides, and the way of frames between them. The interception is the proxy's, in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from companion.config.link_filter import FilterRule
from companion.mavlink.endpoint import Link
from companion.mavlink.framing import RawFrame
from companion.mavlink.routing import LinkPlace, Router

Treatment = Callable[[int, list[RawFrame]], None]


class Network:
    """Hands what links receive to the proxy, and what the proxy lets pass to the links where it belongs.

    Frames that go the same way leave together, as they came: one datagram in is one datagram out.

    Parameters
    ----------
    planner, autopilot
        The links of each side, at least one.
    treat
        Called with the number of a link and what it received, filters passed.
    filters
        As of `Router`.
    """

    def __init__(
        self,
        planner: Sequence[Link],
        autopilot: Sequence[Link],
        treat: Treatment,
        *,
        filters: Sequence[FilterRule] = (),
    ) -> None:
        self.links: tuple[Link, ...] = (*planner, *autopilot)
        self.planner_links = range(len(planner))
        self.autopilot_links = range(len(planner), len(self.links))
        self.unrouted_frames = 0
        """Frames with a target that no other link has heard of, and those that every filter kept back."""
        names = [*side_names("planner", len(planner)), *side_names("autopilot", len(autopilot))]
        self.router = Router(
            [LinkPlace(name, link >= len(planner)) for link, name in enumerate(names)], filters
        )
        self._treat = treat
        self._learned: list[set[int]] = [set() for _ in self.links]
        for number, link in enumerate(self.links):
            link.on_frames = partial(self._received, number)

    def forward(self, source: int, frames: list[RawFrame]) -> int:
        """Send frames that came in on a link on their way, in their order; return how many had one.

        A frame's bytes may have been changed on the way here; its header and target are read as they are now.
        """
        router = self.router
        if router.is_wire and not router.filters_out:  # nothing to choose: the usual case, and the cheapest
            self.links[1 - source].send(
                frames[0][0] if len(frames) == 1 else b"".join([f[0] for f in frames])
            )
            return len(frames)
        destinations = router.destinations
        routed = 0
        waiting: list[bytes] = []
        waiting_for = 0
        for frame in frames:
            mask = destinations(source, frame)
            if mask and router.filters_out:
                mask = self._let_out(mask, frame)
            if not mask:
                self.unrouted_frames += 1
                continue
            routed += 1
            if mask != waiting_for:
                if waiting:
                    self._send(waiting_for, waiting)
                    waiting = []
                waiting_for = mask
            waiting.append(frame.data)
        if waiting:
            self._send(waiting_for, waiting)
        return routed

    def _send(self, mask: int, datas: list[bytes]) -> None:
        datagram = datas[0] if len(datas) == 1 else b"".join(datas)
        for number, link in enumerate(self.links):
            if mask >> number & 1:
                link.send(datagram)

    def _let_out(self, mask: int, frame: RawFrame) -> int:
        """Return the links of these that the filters let a frame leave on."""
        for number, link in enumerate(self.links):
            if mask >> number & 1 and not self.router.lets_out(number, frame):
                link.counters.filtered_frames += 1
                mask &= ~(1 << number)
        return mask

    def _received(self, number: int, frames: list[RawFrame]) -> None:
        router = self.router
        if router.filters_in:
            admitted = [frame for frame in frames if router.admits(number, frame)]
            self.links[number].counters.filtered_frames += len(frames) - len(admitted)
            if not admitted:
                return
            frames = admitted
        learned = self._learned[number]
        for frame in frames:
            _, _, system_id, component_id, verified = frame
            if verified and (system_id << 8 | component_id) not in learned and router.learn(number, frame):
                learned.add(system_id << 8 | component_id)
        self._treat(number, frames)


class Side:
    """All links of one side, to send to as to one.

    Parameters
    ----------
    links
        At least one.
    """

    def __init__(self, links: Sequence[Link]) -> None:
        self._links = tuple(links)

    def send(self, datagram: bytes) -> int:
        """Send whole frames to all peers of all links and return how many took them."""
        return sum(link.send(datagram) for link in self._links)


def side_names(side: str, count: int) -> list[str]:
    """Return the names of a side's links: the side's own for one, ``planner.1``, ``planner.2`` for more."""
    return [side] if count == 1 else [f"{side}.{number}" for number in range(1, count + 1)]
