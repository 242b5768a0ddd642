"""Raw messages come from the intake's own thread: in order, whatever happens to the other subscriptions."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import pytest
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from bridge.ros.session import RosSession
from tests.support.ros_peer import Peer
from tests.support.waiting import until


class Heard:
    """What came on one subscription, and in which threads."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.threads: set[str] = set()

    def take(self, cdr: bytes, info: Mapping[str, Any]) -> None:
        """Note one message."""
        assert info["publication_sequence_number"]
        self.texts.append(deserialize_message(cdr, String).data)
        self.threads.add(threading.current_thread().name)


async def test_messages_come_in_order_without_the_executor(session: RosSession, peer: Peer) -> None:
    """All messages of two topics come in their order, in the intake's thread, while the executor is held up."""
    heard = Heard(), Heard()
    for number, one in enumerate(heard):
        await session.run(lambda topic=f"/t{number}", one=one: session.intake.subscribe(String, topic, one.take, 100))
    publishers = [await peer.publisher(String, f"/t{number}", 100, matched=1) for number in (0, 1)]
    go_on = threading.Event()
    held_up = session.submit(lambda: go_on.wait(10))
    texts = [str(number) for number in range(50)]
    for text in texts:
        for publisher in publishers:
            publisher.publish(String(data=text))
    await until(lambda: all(one.texts == texts for one in heard))
    assert heard[0].threads == heard[1].threads == {"macs-ros-intake"}
    assert not held_up.done()
    go_on.set()


async def test_subscriptions_come_and_go(session: RosSession, peer: Peer) -> None:
    """One that ends is gone from ROS and hears no more; one made later works; the one beside them misses nothing."""
    stays, goes, comes = Heard(), Heard(), Heard()
    await session.run(lambda: session.intake.subscribe(String, "/stays", stays.take, 100))
    gone = await session.run(lambda: session.intake.subscribe(String, "/goes", goes.take, 100))
    publisher = await peer.publisher(String, "/stays", 100, matched=1)
    other = await peer.publisher(String, "/goes", 100, matched=1)
    publisher.publish(String(data="first"))
    other.publish(String(data="first"))
    await until(lambda: stays.texts == goes.texts == ["first"])
    await session.run(lambda: session.intake.unsubscribe(gone))
    await peer.sees("/goes", publishers=1, subscriptions=0)
    await session.run(lambda: session.intake.subscribe(String, "/goes", comes.take, 100))
    await until(lambda: other.get_subscription_count() == 1)
    other.publish(String(data="second"))
    publisher.publish(String(data="second"))
    await until(lambda: comes.texts == ["second"] and stays.texts == ["first", "second"])
    assert goes.texts == ["first"]


async def test_a_callback_that_fails_costs_its_message(session: RosSession, peer: Peer) -> None:
    """After an error in a callback the next messages come, there and on other topics."""
    heard = Heard()

    def fail_first(cdr: bytes, info: Mapping[str, Any]) -> None:
        heard.take(cdr, info)
        if len(heard.texts) == 1:
            raise ValueError("on purpose")

    await session.run(lambda: session.intake.subscribe(String, "/t", fail_first, 100))
    publisher = await peer.publisher(String, "/t", 100, matched=1)
    for text in ("one", "two"):
        publisher.publish(String(data=text))
    await until(lambda: heard.texts == ["one", "two"])


async def test_events_of_a_subscription_come(session: RosSession, peer: Peer) -> None:
    """That a publisher came and went is told, though the executor does not know the subscription."""
    counts: list[int] = []
    events = SubscriptionEventCallbacks(
        matched=lambda change: counts.append(change.current_count), use_default_callbacks=False
    )
    await session.run(lambda: session.intake.subscribe(String, "/t", Heard().take, 10, events=events))
    publisher = await peer.publisher(String, "/t", matched=1)
    await until(lambda: counts == [1])
    await peer.session.run(lambda: peer.session.node.destroy_publisher(publisher))
    await until(lambda: counts == [1, 0])


async def test_unsubscribing_while_messages_come_is_quiet(
    session: RosSession, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    """Subscriptions that end in the middle of messages and events leave no error, and the thread goes on."""
    publisher = await peer.publisher(String, "/t", 100)
    events = SubscriptionEventCallbacks(matched=lambda _change: None, use_default_callbacks=False)
    for _ in range(40):
        made = await session.run(lambda: session.intake.subscribe(String, "/t", Heard().take, 10, events=events))
        publisher.publish(String(data="x"))
        await session.run(lambda made=made: session.intake.unsubscribe(made))
    heard = Heard()

    def say() -> bool:
        publisher.publish(String(data="still here"))
        return bool(heard.texts)

    for _ in range(5):
        made = await session.run(lambda: session.intake.subscribe(String, "/t", heard.take, 10, events=events))
        with suppress(AssertionError):
            await until(say, 10)
        if heard.texts:
            break
        # of so many that come and go at once Fast DDS sometimes does not tell the publisher of the last: not ours
        assert publisher.get_subscription_count() == 0
        await session.run(lambda made=made: session.intake.unsubscribe(made))
    assert heard.texts
    assert not caplog.records
