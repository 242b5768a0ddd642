"""Robot to robot: messages of collective awareness, there and back, and what an uninvolved robot's link carries.

``hop``: there and back between modules of two robots in ROS domains of their own, gateway to gateway over one router,
against what such a way is made of: raw Zenoh there and back, and a ROS topic there and back on either robot. Target:
at most twice that. ``quiet``: 20 robots all send to one; how much of that data an uninvolved robot's link carries,
whose modules take the same type; none is allowed. On the plain topic it carries all of it.

``python -m benchmarks.awareness KIND ...`` is the workers' program: ``module``, ``gateway``, ``senders``, ``plain``.
"""

from __future__ import annotations

import array
import asyncio
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack
from functools import partial
from statistics import median
from typing import Any

from .figures import Figure
from .link import CountingLink
from .plan import Case, Plan, in_turn
from .processes import Program, Stage
from .worker import say, serve

SIZE = 1024
ROBOTS = 20
SETTLE_S = 1.0
"""How long bytes that are on their way may take to be counted."""


# -- the run ---------------------------------------------------------------------------------------------------------


class DownLink(CountingLink):
    """A link whose bytes are counted on the way to the robot. ``sent``: so far."""

    def _pump(self, source: socket.socket, target: socket.socket, counted: bool) -> None:
        super()._pump(source, target, not counted)


def hop(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """From a module to another robot's module and back, against raw Zenoh and a ROS topic on either robot."""
    count = max(100, int(300 * plan.scale))
    router = stage.router()
    domain = 101 + os.getpid() % 40
    for number in (0, 1):
        stage.worker("awareness", "gateway", domain + number, f"drone{number}", f"tcp/127.0.0.1:{router}")
    near, _ = stage.worker("awareness", "module", domain)
    far, _ = stage.worker("awareness", "module", domain + 1)
    far.ask("echo", incoming="/bench_in", outgoing="/gateway_out", kind="bench")
    near.ask("ping", incoming="/bench_in", outgoing="/gateway_out", agent="drone1", kind="bench", size=SIZE, count=20)

    ros_near, _ = stage.worker("awareness", "module", domain + 2)
    ros_far, _ = stage.worker("awareness", "module", domain + 2)
    ros_far.ask("echo", incoming="/ping", outgoing="/pong", kind="")
    raw_near, _ = stage.worker("raw", "zenoh", router)
    raw_far, _ = stage.worker("raw", "zenoh", router)
    raw_far.ask("echo")
    raw_near.ask("ping", size=SIZE, count=20)

    def middle(worker: Program, **arguments: object) -> float:
        return float(median(worker.ask("ping", size=SIZE, count=count, **arguments)["times"])) * 1e6

    ways = in_turn(
        plan.rounds,
        {
            "robot": partial(
                middle, near, incoming="/bench_in", outgoing="/gateway_out", agent="drone1", kind="bench"
            ),
            "zenoh": partial(middle, raw_near),
            "ros": partial(middle, ros_near, incoming="/pong", outgoing="/ping", agent="", kind=""),
        },
    )
    parts = [zenoh + 2 * ros for zenoh, ros in zip(ways["zenoh"], ways["ros"], strict=True)]
    yield Figure("module to module and back, p50", ways["robot"], parts, "Zenoh + 2 x ROS topic", "us", at_most=2.0)
    yield Figure("  of that: ROS topic and back", ways["ros"], ways["robot"], "the whole", "us")
    yield Figure("  of that: raw Zenoh and back", ways["zenoh"], ways["robot"], "the whole", "us")


def quiet(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Bytes on an uninvolved robot's link while 20 others all send to one of them."""
    count = max(20, int(100 * plan.scale))
    router = stage.router()
    link = DownLink(router)
    domain = 141 + os.getpid() % 40
    stage.worker("awareness", "gateway", domain, "uninvolved", f"tcp/127.0.0.1:{link.port}")
    module, _ = stage.worker("awareness", "module", domain)
    module.ask("echo", incoming="/bench_in", outgoing="/nowhere", kind="bench")
    senders, _ = stage.worker("awareness", "senders", router, ROBOTS)
    plain, _ = stage.worker("awareness", "plain", domain + 1)
    mesh, topic, data = [], [], []
    for _ in range(plan.rounds):
        time.sleep(SETTLE_S)
        before = link.sent
        sent = senders.ask("send", count=count, size=SIZE)["bytes"]
        time.sleep(SETTLE_S)
        mesh.append(float(link.sent - before))
        topic.append(float(plain.ask("carry", count=count * ROBOTS, size=SIZE)["bytes"]))
        data.append(float(sent))
    link.close()
    # less than one message in all: what is left is Zenoh's keep-alive
    bound = SIZE / median(data)
    yield Figure(f"uninvolved robot's link, {ROBOTS} to 1", mesh, data, "bytes of data sent", "B", at_most=bound)
    yield Figure("  the same on the plain topic", topic, data, "bytes of data sent", "B")


CASES: dict[str, Case] = {"awareness": hop, "awareness-quiet": quiet}
"""What needs rclpy and as2_ca_msgs, by its name on the command line."""


# -- workers ---------------------------------------------------------------------------------------------------------


class RosModule:
    """A ROS node that plays ping-pong with LocalGenericMessage, on topics or through its robot's gateway."""

    def __init__(self, domain: int) -> None:
        from as2_ca_msgs.msg import LocalGenericMessage
        from as2_ca_msgs.srv import RegisterModule

        from bridge.ros.session import RosSession

        self.message = LocalGenericMessage
        self.registration = RegisterModule
        self.session = RosSession("module", domain_id=domain)
        self.publishers: dict[str, Any] = {}
        self.heard: dict[str, threading.Event] = {}

    def echo(self, incoming: str, outgoing: str, kind: str) -> dict[str, Any]:
        """Send back what comes, to its sender."""
        publisher = self._publisher(outgoing)

        def answer(message: Any) -> None:
            publisher.publish(message)

        self._listen(incoming, kind, answer)
        return {}

    def ping(self, incoming: str, outgoing: str, agent: str, kind: str, size: int, count: int) -> dict[str, Any]:
        """Send and wait for the answer, one at a time; the seconds each took. Repeats what gets none."""
        publisher = self._publisher(outgoing)
        if incoming not in self.heard:
            heard = self.heard[incoming] = threading.Event()
            self._listen(incoming, kind, lambda _message: heard.set())
        heard = self.heard[incoming]
        message = self.message(agent=agent, type=kind, data=array.array("B", bytes(size)))
        times = []
        while len(times) < count:
            heard.clear()
            began = time.perf_counter()
            publisher.publish(message)
            if heard.wait(0.5):
                times.append(time.perf_counter() - began)
        return {"times": times}

    def _publisher(self, topic: str) -> Any:
        if topic not in self.publishers:
            made = self.session.submit(lambda: self.session.node.create_publisher(self.message, topic, 100))
            self.publishers[topic] = made.result()
        return self.publishers[topic]

    def _listen(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Subscribe; ``kind``, if any, is registered with the gateway."""
        node = self.session.node
        self.session.submit(lambda: node.create_subscription(self.message, topic, callback, 100)).result()
        if not kind:
            return
        client = self.session.submit(lambda: node.create_client(self.registration, "register_module")).result()
        while not client.service_is_ready():
            time.sleep(0.05)
        request = self.registration.Request(type=kind, module_name="bench")
        answer = self.session.submit(lambda: client.call_async(request)).result()
        while not answer.done():
            time.sleep(0.05)
        # gone again: on its own hops the module is to be like the one that is measured without a gateway
        self.session.submit(lambda: node.destroy_client(client)).result()


class Plain:
    """The plain topic of as2_ca: robots publish to one of them, and another one counts what it gets."""

    def __init__(self, domain: int) -> None:
        from as2_ca_msgs.msg import InterAgentMessage

        from bridge.ros.session import RosSession

        self.message = InterAgentMessage
        self.bytes = 0
        self.all_here = threading.Event()
        self.wanted = 0
        self.uninvolved = RosSession("uninvolved", domain_id=domain)
        self.sender = RosSession("sender", domain_id=domain)
        for session, make in ((self.uninvolved, self._listen), (self.sender, self._publish)):
            session.submit(lambda make=make: make()).result()

    def carry(self, count: int, size: int) -> dict[str, Any]:
        """Publish so many messages for ``one``; the data bytes that the uninvolved robot received."""
        while not self.publisher.get_subscription_count():
            time.sleep(0.01)
        self.bytes, self.wanted = 0, count * size
        self.all_here.clear()
        for number in range(count):
            message = self.message(sender=f"drone{number % ROBOTS}", receiver="one", type="bench")
            message.data = array.array("B", bytes(size))
            self.publisher.publish(message)
            if number % 50 == 49:
                time.sleep(0.02)  # the depth is 100
        self.all_here.wait(5)
        return {"bytes": self.bytes}

    def _listen(self) -> None:
        self.uninvolved.node.create_subscription(self.message, "/agent_to_agent", self._take, 1000)

    def _publish(self) -> None:
        self.publisher = self.sender.node.create_publisher(self.message, "/agent_to_agent", 1000)

    def _take(self, message: Any) -> None:
        self.bytes += len(message.data)
        if self.bytes >= self.wanted:
            self.all_here.set()


async def senders(router: int, count: int) -> None:
    """So many robots and the one they send to, each with a session of its own."""
    import macs_zenoh
    from macs_zenoh import awareness

    endpoint = [f"tcp/127.0.0.1:{router}"]
    async with AsyncExitStack() as stack:

        async def robot(name: str) -> awareness.Awareness:
            agent = await stack.enter_async_context(macs_zenoh.join("ros", connect=endpoint))
            return await stack.enter_async_context(awareness.join(agent, name))

        one = await robot("one")
        robots = [await robot(f"drone{number}") for number in range(count)]
        got = 0
        all_here = asyncio.Event()
        wanted = 0

        def take(message: awareness.Received) -> None:
            nonlocal got
            got += len(message.data)
            if got >= wanted:
                all_here.set()

        one.register("bench", take)
        for sender in robots:
            await sender.wait_for("one", "bench", timeout_s=10)
        say({})
        loop = asyncio.get_running_loop()
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            command = json.loads(line)
            got, wanted = 0, command["count"] * command["size"] * count
            all_here.clear()
            data = os.urandom(command["size"])
            for _ in range(command["count"]):
                for sender in robots:
                    sender.send("one", "bench", data)
                await asyncio.sleep(0)
            await asyncio.wait_for(all_here.wait(), 20)
            say({"bytes": got})


def gateway(domain: int, name: str, endpoint: str) -> int:
    """``macs awareness`` in a domain; ready as a worker is."""
    from bridge.cli import main as macs
    from bridge.cli import running

    os.environ["ROS_DOMAIN_ID"] = str(domain)
    running.say_ready = lambda _what: say({})
    return macs(["awareness", "--name", name, "-e", endpoint])


def work(kind: str, *arguments: str) -> int:
    """Be a worker."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    if kind == "gateway":
        return gateway(int(arguments[0]), arguments[1], arguments[2])
    if kind == "senders":
        asyncio.run(senders(int(arguments[0]), int(arguments[1])))
    elif kind == "module":
        module = RosModule(int(arguments[0]))
        serve({}, {"echo": module.echo, "ping": module.ping})
        module.session.close()
    else:
        plain = Plain(int(arguments[0]))
        serve({}, {"carry": plain.carry})
        plain.sender.close()
        plain.uninvolved.close()
    return 0


if __name__ == "__main__":
    sys.exit(work(*sys.argv[1:]))
