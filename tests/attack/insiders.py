"""Attacks with a certificate: everything that the rules of a router let it do, as much as goes. Sections 2 and 3.

One row for each kind of certificate that a policy makes, and for each thing that access control knows: puts,
questions, tokens, subscriptions, answers, and looking for who is there. What it may not do, the router does not let
through; `tests/integration/test_security.py` holds that.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh

from macs_zenoh.mesh.zenoh_config import zenoh_config
from tests.attack.raw import ROS, frame, management, metadata
from tests.attack.secured import INSIDERS, Rights, mesh_of
from tests.attack.sessions import BLOCK, OPEN_QUERIES, URGENT
from tests.attack.table import Target, enter

DATA = zenoh.Priority.DATA
TWIST = b"\x00\x01\x00\x00" + struct.pack("<6d", 9.0, 0, 0, 0, 0, 0)


@contextmanager
def session(target: Target, name: str) -> Iterator[zenoh.Session]:
    """A client of the router, with somebody's certificate."""
    with zenoh.open(zenoh_config(mesh_of(_pki(target), name))) as opened:
        yield opened


def _pki(target: Target) -> Path:
    assert target.pki is not None, "this attack is made with a certificate"
    return target.pki


def _said(target: Target) -> list[bytes]:
    """A request, a command, topic data, something for others, and what is no frame."""
    streamed = management("RosAgentSubscriberDataForwarder", dest_agents={"2": [256, 257, 258]})
    about = metadata(sender_agent_type=ROS, node_type=1, node_name="nd__x", data_exchange_type="std_msgs/String")
    command = metadata(node_type=2, node_name="nd__cmd_vel", data_exchange_type="geometry_msgs/Twist")
    release = metadata(node_type=2, node_name="nd__emergency_stop", data_exchange_type="std_msgs/Bool")
    to = {"to": ROS, "ids": [target.robot]}
    return [
        frame(metadata=metadata(message_manager="RobotStatus"), **to),
        frame(metadata=command, data=TWIST, **to),
        frame(metadata=release, data=b"\x00\x01\x00\x00\x00", **to),
        frame(streamed, about, bytes(64)),
        frame(metadata=metadata(message_manager="Hello"), data=bytes(64), to=2, ids=[256, 257, 258]),
        bytes(64),
    ]


def puts(target: Target, name: str) -> None:
    """Samples at full rate on each key that it may put to."""
    said, keys = _said(target), Rights(_pki(target), name).keys("put")
    with session(target, name) as mesh:
        publishers = [
            mesh.declare_publisher(key, congestion_control=BLOCK, priority=priority)
            for key in keys
            for priority in (URGENT, DATA)
        ]
        while target.running() and publishers:
            for publisher in publishers:
                for payload in said:
                    publisher.put(payload)
                if not target.running():
                    return
        while target.rest(0.2):  # it may put nothing
            pass


def questions(target: Target, name: str) -> None:
    """Queries at full rate on each key that it may ask."""
    keys = Rights(_pki(target), name).keys("query")
    asked = frame(metadata=metadata(), data=b"false", to=ROS, ids=[target.robot])
    sent, answered = 0, [0]

    def count(_reply: object) -> None:
        answered[0] += 1

    with session(target, name) as mesh:
        while target.running() and keys:
            for key in keys:
                mesh.get(key, count, payload=asked, priority=URGENT, timeout=1.0)
            sent += len(keys)
            if sent - answered[0] > OPEN_QUERIES:
                target.rest(0.005)
        while target.rest(0.2):
            pass


def tokens(target: Target, name: str) -> None:
    """Tokens on each key on which it may be there, that come and go at full rate."""
    keys = Rights(_pki(target), name).keys("liveliness_token")
    with session(target, name) as mesh:
        while target.running():
            for declared in [mesh.liveliness().declare_token(key) for key in keys]:
                declared.undeclare()


def subscriptions(target: Target, name: str) -> None:
    """Subscriptions to all that it may hear, that come and go at full rate."""
    expressions = Rights(_pki(target), name).expressions("declare_subscriber")[:200]
    with session(target, name) as mesh:
        while target.running():
            for declared in [mesh.declare_subscriber(each, lambda _: None) for each in expressions]:
                declared.undeclare()


def answers(target: Target, name: str) -> None:
    """Being there for all that it may answer, with nonsense, and coming and going at full rate."""
    expressions = Rights(_pki(target), name).expressions("declare_queryable")[:200]

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"nonsense")

    with session(target, name) as mesh:
        kept = [mesh.declare_queryable(each, answer, complete=True) for each in expressions]
        while target.running():
            for declared in [mesh.declare_queryable(each, answer) for each in expressions]:
                declared.undeclare()
        del kept


def looking(target: Target, name: str) -> None:
    """Asking at full rate for all tokens that it may watch, and watching them again and again."""
    expressions = Rights(_pki(target), name).expressions("liveliness_query")
    with session(target, name) as mesh:
        while target.running():
            for each in expressions:
                mesh.liveliness().get(each, lambda _: None, timeout=1.0)
                mesh.liveliness().declare_subscriber(each, lambda _: None, history=True).undeclare()


WAYS: dict[str, tuple[int, Callable[[Target, str], None]]] = {
    "puts": (3, puts),
    "questions": (3, questions),
    "tokens": (2, tokens),
    "subscriptions": (2, subscriptions),
    "answers": (2, answers),
    "looking": (2, looking),
}


SEEN = {(puts, "gateway"), (puts, "robot"), (questions, "watching_gateway")}
"""With these somebody waited for seconds."""


def _made(way: Callable[[Target, str], None], kind: str, name: str) -> Callable[[Target], None]:
    def run(target: Target) -> None:
        way(target, name)

    run.__name__ = f"{way.__name__}_of_a_certified_{kind}"
    run.__doc__ = f"{way.__doc__} With the certificate of: {kind.replace('_', ' ')}."
    return run


for _kind, _name in INSIDERS.items():
    for _section, _way in WAYS.values():
        _to_headsets = _way is puts and _kind in ("gateway", "watching_gateway", "robot")
        _row = _made(_way, _kind, _name)
        enter(_row, _section, "certificate", seen=(_way, _kind) in SEEN, addressed=_to_headsets)
