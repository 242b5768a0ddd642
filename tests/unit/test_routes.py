"""Where the frames of one connection go, and what an agent makes up."""

from __future__ import annotations

from bridge.gateway.routes import KNOWN_ROUTES, STRANGERS_PER_S, Routes
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import Metadata
from macs_zenoh.protocol.routing import keys_of
from macs_zenoh.protocol.wire import Frame, encode_frame, encode_message, parse_frame

ONLINE = {(2, agent_id) for agent_id in range(1, 1001)}
ME = (2, 7)


def frame(agent_type: int, ids: list[int], groups: list[int] | None = None) -> Frame:
    """A frame with this destination."""
    return parse_frame(encode_frame(agent_type, ids, groups or [], message=encode_message(Metadata().encode())))


def routes() -> Routes:
    """Those of a connection at time 0."""
    return Routes(ONLINE, lambda key: False, 0.0)


def test_a_route_is_worked_out_once() -> None:
    """What a destination means is known the second time, until the connection has another id."""
    known = routes()
    sent = frame(2, [1, 2], [3])
    assert known.find(sent.destination) is None
    route = known.work_out(sent, ME, 0.0)
    assert route.keys == keys_of(sent.header, *ME)
    assert route.agents == [(2, 1), (2, 2)]
    assert known.find(sent.destination) is route
    known.forget()
    assert known.find(sent.destination) is None


def test_everybody_who_is_online_may_be_sent_to_at_once() -> None:
    """A thousand agents that are there are no strangers."""
    known = routes()
    for agent_id in range(1, 1001, 10):
        assert known.work_out(frame(2, list(range(agent_id, agent_id + 10))), ME, 0.0).left_out == 0


def test_what_an_agent_makes_up_goes_nowhere() -> None:
    """Of 60 000 destinations that nobody has, some are tried each second, and the rest makes no key; those who are
    there get theirs in the same frames."""
    known = routes()
    keys: list[str] = []
    left_out = 0
    for first in range(2000, 62_000, 9):
        route = known.work_out(frame(2, [1, *range(first, first + 9)]), ME, 0.0)
        keys += [key for key in route.keys if "/1/unity/7" not in key]
        left_out += route.left_out
        assert any(key.startswith("macs/to/unity/0/1/") for key in route.keys)
    assert len(set(keys)) <= STRANGERS_PER_S
    assert left_out >= 59_900
    assert known.work_out(frame(2, [2000]), ME, 1.0).keys


def test_groups_that_are_made_up_are_strangers_too() -> None:
    """Groups of types that nobody has are bounded; those named before stay."""
    known = routes()
    left_out = sum(
        known.work_out(frame(kind, [], list(range(first, first + 10))), ME, 0.0).left_out
        for kind in range(3, 250)
        for first in range(1, 240, 10)
    )
    assert left_out > 50_000
    assert known.work_out(frame(3, [], list(range(1, 11))), ME, 0.0).left_out == 0


def test_what_is_remembered_is_bounded() -> None:
    """Combinations of those who are there are without end, what is kept of them is not."""
    known = routes()
    for first in range(1, 1000):
        for second in range(1, 20):
            known.work_out(frame(2, [first, second]), ME, 0.0)
    assert len(known._known) <= KNOWN_ROUTES


def test_a_broadcast_names_nobody() -> None:
    """Type 0 goes to everybody, whatever it names."""
    route = routes().work_out(frame(0, [5000, 5001], [9]), ME, 0.0)
    assert (route.keys, route.agents, route.left_out) == (["macs/all/unity/7"], [], 0)


def test_whom_a_connection_reaches() -> None:
    """By id, by group, with everybody: only those may ask it to slow down."""
    here, member, other = (AgentInfo(2, number, group, "a") for number, group in ((1, 0), (2, 9), (3, 0)))
    known = routes()
    assert not any(map(known.reach, (here, member, other)))
    known.work_out(frame(2, [1], [9]), ME, 0.0)
    assert [known.reach(agent) for agent in (here, member, other)] == [True, True, False]
    known.work_out(frame(0, [], []), ME, 0.0)
    assert known.reach(other)
