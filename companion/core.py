"""The parts that decide, put together: the same in the service and in a replay of what it was given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

from companion.addressed import AddressedSetpoints
from companion.config import Config
from companion.interception import Interception
from companion.io.feed import Feed
from companion.log import Log
from companion.mavlink.endpoint import Link
from companion.mavlink.identity import Identity
from companion.mavlink.network import Side
from companion.mavlink.proxy import InlineProxy, OwnComponent
from companion.mavlink.signing import Signatures
from companion.own import Own
from companion.takeover import TakeoverFlight


@dataclass(frozen=True, slots=True)
class Core:
    """What decides, between two sides of links.

    Attributes
    ----------
    identity
        Our voice.
    flight
        Vision, MAVLink and the switch S.
    own
        Our own component.
    proxy
        Between the links.
    takeover
        What flies in place of the mission, where that is configured.
    """

    identity: Identity
    flight: Interception
    own: Own
    proxy: InlineProxy
    takeover: TakeoverFlight | None

    @classmethod
    def build(
        cls,
        config: Config,
        planner: Sequence[Link],
        autopilot: Sequence[Link],
        *,
        now_ns: Callable[[], int],
        began_ns: int,
        signatures: Signatures | None,
        apply: Callable[[Config], None],
        feed: Feed,
        log: Log,
    ) -> Self:
        """Put it together.

        Parameters
        ----------
        config
            The whole configuration.
        planner, autopilot
            The links of both sides.
        now_ns
            Monotonic time; it stands still while a datagram is dealt with.
        began_ns
            When the service began.
        signatures
            Verifies and signs; None: there is no key.
        apply
            Takes settings that act outside of the flight.
        feed
            Is told what happens.
        log
            Takes the events.
        """
        identity = Identity(
            Side(planner),
            Side(autopilot),
            component_id=config.link.component_id,
            now_ns=now_ns,
            signatures=signatures,
        )
        flight = Interception(config, identity=identity, log=log, feed=feed)
        own = Own(config, flight, identity, log=log, now_ns=began_ns, apply=apply, signatures=signatures)
        takeover, tap = _way_of_interception(config, flight, identity, own, log, signatures)
        proxy = InlineProxy(
            planner,
            autopilot,
            flight,
            now_ns=now_ns,
            signatures=signatures,
            own=tap,
            filters=config.link.filter_rules,
        )
        return cls(identity, flight, own, proxy, takeover)


def _way_of_interception(
    config: Config,
    flight: Interception,
    identity: Identity,
    own: Own,
    log: Log,
    signatures: Signatures | None,
) -> tuple[TakeoverFlight | None, OwnComponent]:
    """Return what flies in place of the mission, where that is configured, and what the proxy offers frames to."""
    match config.interception.mode:
        case "takeover":
            takeover = TakeoverFlight(
                config,
                flight,
                identity,
                log=log,
                own=own.component,
                engaged=lambda: own.engagement.engaged,
            )
            return takeover, takeover
        case "addressed":
            return None, AddressedSetpoints(flight, identity, own=own.component, signatures=signatures)
        case "inline":
            return None, own.component
