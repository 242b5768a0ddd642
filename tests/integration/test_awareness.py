"""Messages by name between real sessions on a real router, without ROS."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from macs_zenoh import awareness
from macs_zenoh.awareness import Awareness, Received
from macs_zenoh.errors import Unreachable, UsageError
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import NAME, NAMED, NAMED_ALL
from macs_zenoh.protocol.named import Outcome
from tests.support.local import patient
from tests.support.programs import Program, free_port, macs
from tests.support.waiting import PATIENCE_S, until

Meet = Callable[..., Awaitable[Awareness]]


@pytest.fixture
async def meet(router: str) -> AsyncIterator[Meet]:
    """Joins the mesh with a name; keyword arguments are `awareness.join`'s."""
    async with AsyncExitStack() as stack:

        async def meet(name: str, **options: object) -> Awareness:
            agent = await stack.enter_async_context(macs_zenoh.join("ros", settings=patient(router)))
            return await stack.enter_async_context(awareness.join(agent, name, **options))  # type: ignore[arg-type]

        yield meet


class Module:
    """Registers a type and keeps what comes."""

    def __init__(self, owner: Awareness, message_type: str, *, last_value: bool = False) -> None:
        self.received: asyncio.Queue[Received] = asyncio.Queue()
        self.registration = owner.register(message_type, self.received.put_nowait, last_value=last_value)

    async def next(self) -> Received:
        return await asyncio.wait_for(self.received.get(), PATIENCE_S)


async def test_a_message_reaches_its_receiver_only(meet: Meet) -> None:
    """One of three gets what is sent to its name; what is sent to all reaches both others, not the sender."""
    a, b, c = [await meet(name) for name in "abc"]
    modules = [Module(agent, "t") for agent in (a, b, c)]
    for name in "bc":
        await a.wait_for(name, "t", timeout_s=PATIENCE_S)
    assert a.send("b", "t", b"to b") is Outcome.SENT
    assert a.send("", "t", b"to all") is Outcome.SENT
    first, second = await modules[1].next(), await modules[1].next()
    assert {(m.sender, m.type, m.data, m.to_all) for m in (first, second)} == {
        ("a", "t", b"to b", False),
        ("a", "t", b"to all", True),
    }
    assert (await modules[2].next()).data == b"to all"
    assert await c.deliver("a", "t", b"end", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    assert (await modules[0].next()).data == b"end"
    assert all(module.received.empty() for module in modules)


async def test_delivery_is_known(meet: Meet) -> None:
    """Sent, delivered, no such agent, nobody registered, to itself: each is told and counted."""
    a, b = await meet("a"), await meet("b")
    await a.wait_for("b", timeout_s=PATIENCE_S)
    assert a.send("b", "t", b"") is Outcome.NOT_REGISTERED
    assert a.send("", "t", b"") is Outcome.NOT_REGISTERED
    assert a.send("nobody", "t", b"") is Outcome.NO_SUCH_AGENT
    assert a.send("a", "t", b"") is Outcome.TO_ITSELF
    assert await a.deliver("nobody", "t", b"", deadline_s=0.1) is Outcome.NO_SUCH_AGENT
    outcome, deadline_s = Outcome.LATE, 0.1
    while outcome is Outcome.LATE:  # it may be busy
        outcome, deadline_s = await a.deliver("b", "t", b"", deadline_s=deadline_s), 2 * deadline_s
    assert outcome is Outcome.NOT_REGISTERED
    Module(b, "t")
    assert await a.deliver("b", "t", b"x", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    counted = {name: count for name, count in a.counters.items() if name != "late"}
    assert counted == {"not_registered": 3, "no_such_agent": 2, "to_itself": 1, "delivered": 1}


async def test_an_unregistered_type_is_warned_of_once(meet: Meet, caplog: pytest.LogCaptureFixture) -> None:
    """Messages of a type that nobody registered cost one line in the log and are counted."""
    a, b = await meet("a"), await meet("b")
    module = Module(b, "known")
    await a.wait_for("b", "known", timeout_s=PATIENCE_S)
    for _ in range(5):
        a.send("b", "unknown", b"")
    assert await a.deliver("b", "known", b"end", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    await module.next()
    await until(lambda: b.counters["unregistered"] == 5)
    assert [r.getMessage().count("unknown") for r in caplog.records if r.name == "macs.awareness"] == [1]


async def test_a_message_waits_for_its_receiver_until_its_deadline(meet: Meet) -> None:
    """A message to an agent that comes and registers later is delivered, once, when it has."""
    a = await meet("a")
    delivery = asyncio.create_task(a.deliver("b", "t", b"waited", deadline_s=PATIENCE_S))
    b = await meet("b")
    assert not delivery.done()
    module = Module(b, "t")
    assert await asyncio.wait_for(delivery, PATIENCE_S) is Outcome.DELIVERED
    assert (await module.next()).data == b"waited"
    assert module.received.empty()


async def test_a_deadline_travels_along(meet: Meet) -> None:
    """The receiver knows until when a message is good; without a deadline it always is."""
    a, b = await meet("a"), await meet("b")
    module = Module(b, "t")
    await a.wait_for("b", "t", timeout_s=PATIENCE_S)
    now = asyncio.get_running_loop().time()
    await a.deliver("b", "t", b"", deadline_s=60)
    good_until = (await module.next()).good_until
    assert good_until is not None
    assert 60 <= good_until - now < 70
    a.send("b", "t", b"")
    assert (await module.next()).good_until is None


async def test_who_joins_late_learns_the_last_values(meet: Meet) -> None:
    """On request, the last message to all of each agent that is there, and of each that comes, arrives once."""
    a = await meet("a")
    Module(a, "t")
    for number in range(3):
        a.send("", "t", b"a%d" % number)
    late = Module(await meet("late"), "t", last_value=True)
    assert (await late.next()).data == b"a2"
    plain = Module(await meet("plain"), "t")
    await a.wait_for("plain", "t", timeout_s=PATIENCE_S)
    a.send("", "t", b"a3")
    assert [(await late.next()).data, (await plain.next()).data] == [b"a3", b"a3"]
    assert late.received.empty()


async def test_a_rate_limit_holds_per_type(meet: Meet) -> None:
    """What is sent more often than allowed is dropped, told and counted; other types pass."""
    a, b = await meet("a", max_hz={"t": 0.1}), await meet("b")
    module, other = Module(b, "t"), Module(b, "other")
    await a.wait_for("b", "t", timeout_s=PATIENCE_S)
    await a.wait_for("b", "other", timeout_s=PATIENCE_S)
    outcomes = [a.send("b", "t", b"%d" % n) for n in range(4)]
    assert outcomes == [Outcome.SENT, *[Outcome.RATE_LIMITED] * 3]
    assert [a.send("b", "other", b"") for _ in range(3)] == [Outcome.SENT] * 3
    assert (await module.next()).data == b"0"
    for _ in range(3):
        await other.next()
    assert module.received.empty()
    assert a.counters["rate_limited"] == 3


@pytest.mark.parametrize("name", ["a/b", "with space", "Дрон 🤖", "@home", "*", "**", "50%", "x" * 200])
async def test_any_text_is_a_name_and_a_type(meet: Meet, name: str) -> None:
    """Slashes, spaces, wildcards and Unicode reach exactly the agent of that name."""
    a, b = await meet("a"), await meet(name)
    module, other = Module(b, name), Module(a, name)
    await a.wait_for(name, name, timeout_s=PATIENCE_S)
    assert a.send(name, name, b"1") is Outcome.SENT
    assert (await module.next())[:3] == ("a", name, b"1")
    assert await b.deliver("a", name, b"2", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    assert (await other.next())[:3] == (name, name, b"2")


@pytest.mark.parametrize(
    ("receiver", "message_type"), [("b", ""), ("x" * 201, "t"), ("b", "\ud800"), ("b", "x" * 201)]
)
async def test_what_cannot_be_sent_is_an_error(meet: Meet, receiver: str, message_type: str) -> None:
    """An empty, endless or broken word raises UsageError, and what is sent next arrives."""
    a, b = await meet("a"), await meet("b")
    module = Module(b, "t")
    with pytest.raises(UsageError):
        a.send(receiver, message_type, b"")
    with pytest.raises(UsageError):
        await a.deliver("", "t", b"", deadline_s=1)
    assert await a.deliver("b", "t", b"next", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    assert (await module.next()).data == b"next"


async def test_an_empty_name_is_an_error(meet: Meet) -> None:
    """Without a name nobody joins."""
    with pytest.raises(UsageError, match="agent name is empty"):
        await meet("")


@pytest.mark.megabytes
@pytest.mark.parametrize("how", ["send", "deliver"])
async def test_ten_megabytes_arrive_whole(meet: Meet, how: str) -> None:
    """10 MB to one and to all arrive byte for byte, with small messages in between; above the limit is refused."""
    a, b = await meet("a"), await meet("b", max_bytes=20)
    module, small = Module(b, "t"), Module(b, "small")
    for message_type in ("t", "small"):
        await a.wait_for("b", message_type, timeout_s=PATIENCE_S)
    data = bytes(range(256)) * 40_000
    if how == "send":
        assert a.send("b", "t", data) is Outcome.SENT
        a.send("", "t", data)
        assert (await module.next()).data == data
    else:
        assert await a.deliver("b", "t", data, deadline_s=PATIENCE_S) is Outcome.DELIVERED
    assert a.send("b", "small", b"x") is Outcome.SENT
    assert (await small.next()).data == b"x"
    assert (await module.next()).data == data
    with pytest.raises(UsageError, match="above the limit of 20"):
        b.send("a", "t", bytes(21))
    assert b.counters["too_large"] == 1


async def test_a_name_belongs_to_one(meet: Meet, router: str) -> None:
    """A second agent of one name is refused, and the first keeps working."""
    a = await meet("a")
    module = Module(a, "t")
    with pytest.raises(UsageError, match="'a' is already on the mesh"):
        await meet("a")
    b = await meet("b")
    assert await b.deliver("a", "t", b"x", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    await module.next()


async def test_a_name_that_two_have_is_noticed(meet: Meet, caplog: pytest.LogCaptureFixture) -> None:
    """When two halves of a mesh meet in which a name was given twice, the log says so and it is counted."""
    a, b = await meet("a"), await meet("b")
    token = b.mesh.declare_token(NAME.of(name="a", type=1, id=9, zid=b.mesh.zid))
    await until(lambda: a.counters["name_taken_twice"] == 1)
    token.close()
    assert f"session {b.mesh.zid} is called 'a' as well" in caplog.text


async def test_a_bad_message_costs_only_itself(meet: Meet, caplog: pytest.LogCaptureFixture) -> None:
    """Bytes that are no message, by put and by query, are counted and logged once; the next message arrives."""
    a, b = await meet("a"), await meet("b")
    module = Module(b, "t")
    await a.wait_for("b", "t", timeout_s=PATIENCE_S)
    for payload in (b"", b"\xff\xff\xff\xff", b"\x02\0\0\0{}\0\0\0\0"):
        a.mesh.put(NAMED.of(name="b", message_type="t", from_name="a"), payload)
        a.mesh.put(NAMED_ALL.of(message_type="t", from_name="a"), payload)
        await a.mesh.query(NAMED.of(name="b", message_type="t", from_name="a"), payload, timeout_s=PATIENCE_S)
    assert await a.deliver("b", "t", b"good", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    assert (await module.next()).data == b"good"
    await until(lambda: b.counters["bad_message"] == 9)
    assert len([r for r in caplog.records if "cannot be used" in r.getMessage()]) == 1


async def test_a_failing_callback_costs_the_others_nothing(meet: Meet, caplog: pytest.LogCaptureFixture) -> None:
    """When one of two callbacks for a type fails, the other gets each message."""
    a, b = await meet("a"), await meet("b")
    b.register("t", lambda message: [][1])
    module = Module(b, "t")
    for data in (b"1", b"2"):
        assert await a.deliver("b", "t", data, deadline_s=PATIENCE_S) is Outcome.DELIVERED
        assert (await module.next()).data == data
    assert len([r for r in caplog.records if r.exc_info]) == 2


async def test_a_closed_registration_is_known(meet: Meet) -> None:
    """After the last registration of a type is closed, senders know that nobody takes it."""
    a, b = await meet("a"), await meet("b")
    modules = [Module(b, "t"), Module(b, "t")]
    await a.wait_for("b", "t", timeout_s=PATIENCE_S)
    modules[0].registration.close()
    modules[0].registration.close()
    assert await a.deliver("b", "t", b"x", deadline_s=PATIENCE_S) is Outcome.DELIVERED
    modules[1].registration.close()
    await until(lambda: not a.names.takes("b", "t"))
    assert a.send("b", "t", b"") is Outcome.NOT_REGISTERED


async def test_names_are_listed() -> None:
    """`macs ls` shows the name beside type and id, and others see it come and go."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Program("router", "-l", endpoint), macs_zenoh.join("ros", id=3, settings=patient(endpoint)) as robot:
        seen: list[str] = []
        async with awareness.join(robot, "drone0") as drone:
            drone.on_change(seen.append)
            async with (
                macs_zenoh.join("unity", id=300, settings=patient(endpoint)) as headset,
                awareness.join(headset, "ground"),
            ):
                await drone.wait_for("ground", timeout_s=PATIENCE_S)
                listed = await macs("ls", "--json", "-e", endpoint)
                assert {(a["type"], a["id"], a["name"]) for a in listed} == {
                    ("ros", 3, "drone0"),
                    ("unity", 300, "ground"),
                }
                assert [(n.name, n.type_name, n.id) for n in drone.others()] == [("ground", "unity", 300)]
            await until(lambda: not drone.others())
            assert set(seen) == {"ground"}
        with pytest.raises(Unreachable, match="no agent has this name"):
            async with awareness.join(robot, "again") as again:
                await again.wait_for("ground", timeout_s=0.1)


async def test_nothing_is_lost_for_ever_with_a_router(tmp_path: object) -> None:
    """While the router is gone, sending says so; a delivery waits and arrives when there is a router again."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = Program("router", "-l", endpoint)
    await router.start()
    try:
        async with (
            macs_zenoh.join("ros", id=1, settings=patient(endpoint)) as one,
            macs_zenoh.join("ros", id=2, settings=patient(endpoint)) as two,
            awareness.join(one, "a") as a,
            awareness.join(two, "b") as b,
        ):
            module = Module(b, "t")
            await a.wait_for("b", "t", timeout_s=PATIENCE_S)
            await router.stop()
            await until(lambda: not a.mesh.linked)
            assert a.send("b", "t", b"") is Outcome.NO_ROUTER
            delivery = asyncio.create_task(a.deliver("b", "t", b"waited", deadline_s=PATIENCE_S))
            await router.start()
            assert await delivery is Outcome.DELIVERED
            assert (await module.next()).data == b"waited"
            assert module.received.empty()
    finally:
        await router.stop()


async def test_a_name_that_is_given_up_in_this_moment_can_be_had(
    meet: Meet, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has it leaves after the router has named it, before anybody watches: who joins waits, and has it."""
    async with AsyncExitStack() as stack:
        agent = await stack.enter_async_context(macs_zenoh.join("ros", settings=patient(router)))
        await stack.enter_async_context(awareness.join(agent, "a"))
        really = Mesh.tokens

        async def then_it_leaves(self: Mesh, key: str, *, timeout_s: float = 2.0) -> list[str]:
            found = await really(self, key, timeout_s=timeout_s)
            if key == NAME.every(name="a") and found:
                monkeypatch.setattr(Mesh, "tokens", really)
                await stack.aclose()
                while await self.tokens(key):
                    pass
            return found

        b = await meet("b")
        monkeypatch.setattr(Mesh, "tokens", then_it_leaves)
        assert (await meet("a")).name == "a"
        await b.wait_for("a", timeout_s=PATIENCE_S)
