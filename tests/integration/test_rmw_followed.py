"""A robot whose nodes come back with types of another hash: what of ours follows them, is there all the time."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any, NamedTuple

import pytest

from bridge.rmw_zenoh import ends
from bridge.rmw_zenoh.ends import ZenohPublisher
from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import UnknownMessage
from bridge.ros.shapes import Structure
from bridge.ros.side import ActionType
from bridge.ros.types import InterfaceName
from macs_zenoh.mesh.ros_network import RosNode
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos
from tests.support.rmw_sides import both_sides
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")

STRING = InterfaceName("std_msgs", "msg", "String")
TEXT, STOP = b"\0\1\0\0\3\0\0\0hi\0", b"\0\1\0\0\5\0\0\0stop\0"
QOS, LATCHED = Qos(depth=10), Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
OTHER_HASH = "RIHS01_" + "ab" * 32


class Site(NamedTuple):
    """Our side of a robot, and a node of the robot's."""

    ours: ZenohSession
    node: RosNode
    kept: list[Any]
    """What the robot's nodes have, until the end."""

    async def publisher(self, qos: Qos = QOS) -> ZenohPublisher:
        of = await self.ours.run(lambda: self.ours.message(STRING, "/orders"))
        made = await self.ours.run(lambda: self.ours.advertise(of, "/orders", qos))
        assert isinstance(made, ZenohPublisher)
        return made

    def heard(self, qos: Qos = QOS) -> list[bytes]:
        """What a subscription of the robot's, with another hash, hears from now on."""
        heard: list[bytes] = []
        made = self.node.subscription("/orders", str(STRING), OTHER_HASH, qos, lambda cdr, attached: heard.append(cdr))
        self.kept.append(made)
        return heard


@pytest.fixture
async def site(router: str) -> AsyncIterator[Site]:
    async with both_sides(router) as (ours, theirs):
        yield Site(ours, theirs.node(0, "base"), [])


async def test_a_message_of_that_moment_is_published(site: Site) -> None:
    """What is published while the publisher is made again, from another thread, goes out as ever."""
    publisher = await site.publisher()
    make, published = publisher.make, []

    def make_while_published(type_hash: str) -> Any:
        before = publisher.entity
        publisher.publish(TEXT)
        made = make(type_hash)
        publisher.publish(TEXT)
        published.append(before)
        return made

    publisher.make = make_while_published  # type: ignore[method-assign]
    heard = site.heard()
    await until(lambda: publisher.entity.endpoint.hash == OTHER_HASH, PATIENCE_S)
    assert published

    def comes() -> bool:
        publisher.publish(STOP)
        return STOP in heard

    await until(comes, PATIENCE_S, every_s=0.05)


async def test_one_that_has_just_been_replaced_is_not_published_on(site: Site) -> None:
    """A thread that had taken the entity before it was another one publishes on that."""
    publisher = await site.publisher()
    old = publisher.entity
    site.heard()
    await until(lambda: publisher.entity.endpoint.hash == OTHER_HASH, PATIENCE_S)
    used: list[Any] = []

    class Late:
        """It is closed, and replaced, when it is used."""

        def publish(self, cdr: bytes) -> None:
            used.append(self)
            publisher.entity = now
            old.publish(cdr)

    now, publisher.entity = publisher.entity, Late()
    publisher.publish(STOP)
    assert len(used) == 1


async def test_what_cannot_be_made_again_stays_and_is_tried_again(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """When making it fails, the one before goes on, until it can be had."""
    monkeypatch.setattr(ends, "AGAIN_S", 0.05)
    publisher = await site.publisher()
    make, failed = publisher.make, []

    def fail_twice(type_hash: str) -> Any:
        if len(failed) < 2:
            failed.append(type_hash)
            publisher.publish(TEXT)
            raise OSError("no more of that")
        return make(type_hash)

    publisher.make = fail_twice  # type: ignore[method-assign]
    heard = site.heard()
    await until(lambda: publisher.entity.endpoint.hash == OTHER_HASH, PATIENCE_S)
    assert failed == [OTHER_HASH] * 2

    def comes() -> bool:
        publisher.publish(STOP)
        return bool(heard)

    await until(comes, PATIENCE_S, every_s=0.05)


async def test_what_is_latched_is_there_for_them(site: Site) -> None:
    """As the state of the emergency stop: nodes with the other hash hear it though nobody says it again."""
    publisher = await site.publisher(LATCHED)
    publisher.publish(TEXT)
    publisher.publish(STOP)
    heard = site.heard(LATCHED)
    await until(lambda: heard, PATIENCE_S)
    assert set(heard) == {STOP}


async def test_an_action_of_which_a_part_cannot_be_had_leaves_nothing(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clients that were made before the part that fails are closed again."""

    def fail(*_args: Any) -> None:
        raise OSError("no more of that")

    monkeypatch.setattr(site.ours, "hash_of", lambda topic, of_type: OTHER_HASH)
    monkeypatch.setattr(site.ours, "subscribe", fail)
    of = ActionType(UnknownMessage(""), ("demo_msgs/action/Turn", Structure(())))
    with pytest.raises(OSError, match="no more"):
        await site.ours.run(lambda: site.ours.goals(of, "/turn"))
    assert site.ours._held == []
