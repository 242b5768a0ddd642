"""One TCP agent that comes back over another connection as the same: in bytes, without a socket."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    Configuration,
    Heartbeat,
    Metadata,
    Registration,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.rights import OPEN, Grant, Rights
from macs_zenoh.protocol.tcp_agent import (
    Arrived,
    Event,
    Forbidden,
    Joined,
    Left,
    NotResumed,
    Registering,
    Resumed,
    Sent,
    State,
    TcpAgent,
    Withdrawn,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message

ANNA = Grant("anna", Rights(may=["see", "command", "send"], robots=[1], groups=[3], topics=["/camera/**"]))


def configuration(session: str | None, group: int = 0, **more: object) -> bytes:
    """A headset's, that knows sessions."""
    said = {"extensions": 1, "session": session, **more}
    return encode_frame(management=encode_management(Configuration(UNITY, 0, group, **said)))  # type: ignore[arg-type]


def to_headset(data: bytes = b"x") -> bytes:
    """A frame for headset 9, from nobody in particular."""
    return encode_frame(UNITY, (9,), message=encode_message(Metadata().encode(), data))


def registration() -> bytes:
    """Of /camera/image at robot 1."""
    name = "/camera/image"
    node = AddNode(UNITY, 7, 1, node_name(name), name, "pkg/T")
    asked = Registration(7, 1, node_name(name), [1])
    message = encode_message(Metadata(message_manager=AddNode.manager).encode(), encode_data(node))
    return encode_frame(management=encode_management(asked), message=message)


class Gateway:
    """What a gateway knows of sessions, with one agent that was here before."""

    def __init__(self, grant: Grant = OPEN, group: int = 0) -> None:
        self.former = TcpAgent(7, 42, 0.0, admit=lambda token: grant, resume=self.resume)
        self.former.receive(configuration("", group), 0.0)
        assert self.former.returns

    def resume(self, secret: str, grant: Grant, agent_type: int) -> TcpAgent | None:
        """Whose secret it is."""
        same = (grant.name, agent_type) == (self.former.grant.name, self.former.agent_type)
        return self.former if secret == "secret" and same else None

    def newcomer(self, grant: Grant = OPEN) -> TcpAgent:
        """Somebody on another connection."""
        return TcpAgent(8, 43, 1.0, admit=lambda token: grant, resume=self.resume)


def kinds(events: list[Event]) -> list[type[Event]]:
    """What happened."""
    return [type(event) for event in events]


def test_who_shows_the_secret_is_the_same_agent() -> None:
    """With its id, group and rights, and what follows in the same read is from that id; the one before is nobody."""
    gateway = Gateway(ANNA, group=3)
    assert Registering in kinds(gateway.former.receive(registration(), 0.5))
    newcomer = gateway.newcomer(ANNA)
    events = newcomer.receive(configuration("secret", 3, received=5) + to_headset() + registration(), 1.0)
    assert kinds(events) == [Resumed, Sent, Registering]
    resumed, sent, _ = events
    assert isinstance(resumed, Resumed)
    assert (resumed.former, resumed.spare_id, resumed.received) == (gateway.former, 8, 5)
    assert isinstance(sent, Sent)
    assert (sent.metadata.sender_agent_type, sent.metadata.sender_agent_id) == (UNITY, 7)
    assert (newcomer.agent_id, newcomer.group, newcomer.returns) == (7, 3, True)
    assert newcomer.connection_number == 42
    assert newcomer.recipient is gateway.former.recipient
    assert gateway.former.state is State.GONE
    assert gateway.former.receive(to_headset(), 2.0) == []


def test_frames_are_counted_over_all_connections() -> None:
    """All but the first configuration of each: also those that were not accepted, and each of a run."""
    gateway = Gateway()
    wrong = encode_frame(message=encode_message(b"no json"))
    gateway.former.receive(to_headset() * 3 + wrong + encode_frame(management=b"x"), 0.5)
    assert gateway.former.heard == 5
    newcomer = gateway.newcomer()
    newcomer.receive(configuration("secret") + to_headset(), 1.0)
    assert newcomer.heard == 6
    newcomer.receive(encode_frame(management=encode_management(Heartbeat())), 1.0)
    assert newcomer.heard == 7


@pytest.mark.parametrize("shown", ["other", "secre", "secrets", "SECRET"])
def test_another_secret_makes_a_new_agent(shown: str) -> None:
    """Which is told, and keeps its own id; who had the session goes on."""
    gateway = Gateway()
    newcomer = gateway.newcomer()
    assert kinds(newcomer.receive(configuration(shown), 1.0)) == [NotResumed, Joined]
    assert (newcomer.agent_id, newcomer.returns) == (8, True)
    assert gateway.former.state is State.ONLINE


def test_the_secret_opens_nothing_without_the_same_token() -> None:
    """Neither without one, nor with somebody else's, nor for an agent of another type."""
    gateway = Gateway(ANNA)
    for grant in (OPEN, Grant("bert", ANNA.rights)):
        assert kinds(gateway.newcomer(grant).receive(configuration("secret"), 1.0)) == [NotResumed, Joined]
    robot = Configuration(ROS, 0, extensions=1, session="secret")
    peer = gateway.newcomer(Grant("anna", Rights(may=["robot"])))
    assert kinds(peer.receive(encode_frame(management=encode_management(robot)), 1.0)) == [NotResumed, Joined]
    refused = TcpAgent(9, 44, 1.0, admit=lambda token: None, resume=gateway.resume)
    events = refused.receive(configuration("secret"), 1.0)
    assert isinstance(events[-1], Left)
    assert Resumed not in kinds(events)
    assert gateway.former.state is State.ONLINE


def test_an_existing_program_has_no_session() -> None:
    """Whoever names no extensions, or says nothing of sessions, is not expected back."""
    gateway = Gateway()
    for said in (
        Configuration(UNITY, 0),
        Configuration(UNITY, 0, session="secret"),
        Configuration(UNITY, 0, extensions=1),
    ):
        newcomer = gateway.newcomer()
        assert kinds(newcomer.receive(encode_frame(management=encode_management(said)), 1.0)) == [Joined]
        assert not newcomer.returns


def test_rights_are_judged_anew() -> None:
    """What the token does not permit any more is taken back, from then on as well."""
    gateway = Gateway(ANNA, group=3)
    gateway.former.receive(registration(), 0.5)
    less = Grant("anna", Rights(may=["send"], robots=[1]))
    newcomer = gateway.newcomer(less)
    events = newcomer.receive(configuration("secret", 3) + registration(), 1.0)
    assert kinds(events)[:3] == [Resumed, Withdrawn, Joined]
    assert Forbidden in kinds(events)
    assert Registering not in kinds(events)
    assert newcomer.group == 0


def test_a_closed_group_is_closed_to_who_comes_from_elsewhere() -> None:
    """Groups that not everybody may choose are asked of the address that it has now."""
    gateway = Gateway(group=9)
    newcomer = TcpAgent(8, 43, 1.0, resume=gateway.resume, closed_groups=(9,))
    assert Joined in kinds(newcomer.receive(configuration("secret", 9), 1.0))
    assert (newcomer.agent_id, newcomer.group) == (7, 0)


def test_what_has_arrived_is_told_by_a_heartbeat() -> None:
    """And a heartbeat as existing programs send it says nothing."""
    peer = Gateway().former
    heartbeat = encode_frame(management=encode_management(Heartbeat(received=17)))
    assert peer.receive(heartbeat, 1.0) == [Arrived(17)]
    assert peer.receive(encode_frame(management=encode_management(Heartbeat())), 1.0) == []


def test_silence_is_known_from_other_ends() -> None:
    """Who says nothing may only have lost its network."""
    peer = Gateway().former
    (left,) = peer.tick(peer.next_deadline())
    assert isinstance(left, Left)
    assert left.silent
    goodbye = encode_frame(management=b'{"messageManager":"UnityAgentclientRemover","agentId":7}')
    (left,) = Gateway().former.receive(goodbye, 1.0)
    assert isinstance(left, Left)
    assert not left.silent
