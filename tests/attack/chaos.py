"""Everything is killed, stopped, cut off and flooded for minutes, and comes back each time by itself.

``python -m tests.attack.chaos --minutes 60 --seed 7``. What happens is generated from the seed, which is printed, as
is each step. After every few steps everything is left in peace for a moment, and then these must hold:

* every program runs, and none has a fault in its log;
* every headset is connected, and no two agents have the same id;
* who is online, asked through each gateway and seen on the mesh, is who is there;
* each headset hears the robot's topic again, and the robot has exactly these registrants;
* no thread, no descriptor and no memory is left over.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.attack import table
from tests.attack.scene import BEGIN_S  # sets ROS's environment first
from tests.attack.site import MIB, ROBOT, descriptors, status_bytes, threads

from std_msgs.msg import String  # isort: skip

from bridge.cli import robots
from bridge.headset.client import Headset
from bridge.headset.nodes import Subscription
from bridge.ros.session import RosSession
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.messages import OPERATOR, ROS
from macs_zenoh.protocol.robot_state import RobotStatus
from tests.support.links import Link, counted
from tests.support.programs import ROOT, Program, free_port
from tests.support.routers import Router

COUNT_EVERY_S = 0.02
HEADSETS = 6
MOST_HEADSETS = 16
PEACE_S = 150.0
"""By when everything must be right again: a lease, a program's start, what a flooder has left in the kernel, tens of
megabytes that are worked off at the pace that a gateway allows, and a busy machine."""
STEP_S = 60.0
"""No single step takes so long."""
MORE_THREADS = 8
"""Zenoh and asyncio start some late: for large messages, for names to look up, for a second link."""
MORE_DESCRIPTORS = 16
MORE_BYTES = 96 * MIB
"""Above what a program took when it was first left in peace."""
TOPIC = "/count"


@dataclass
class Person:
    """A headset that wants the robot's topic, on one of the gateways."""

    gateway: int
    headset: Headset
    topic: Subscription
    heard: int = 0
    heard_at: float = 0.0

    async def listen(self) -> None:
        with suppress(MacsError):
            async for message in self.topic:
                self.heard = int(bytes(message.data[8:]).rstrip(b"\0") or 0)
                self.heard_at = time.monotonic()


@dataclass
class Counting:
    """What the robot's topic comes from."""

    session: RosSession
    publisher: Any
    number: int = 0
    refused: list[str] = field(default_factory=list)
    """What ROS said to messages that it did not take, as for a moment while a subscription has died."""

    async def count(self) -> None:
        """Publish, until cancelled."""
        while True:
            self.number += 1
            try:
                self.publisher.publish(String(data=str(self.number)))
            except Exception as error:  # noqa: BLE001 - rclpy's, whatever it is
                self.refused.append(repr(error))
            await asyncio.sleep(COUNT_EVERY_S)

    async def sees(self) -> str:
        """Who takes it, as far as ROS tells its publisher: nobody there, or nobody in the graph, is a fault of DDS."""
        node = self.session.node
        known = await self.session.run(lambda: node.get_subscriptions_info_by_topic(TOPIC))
        takers = [f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in known]
        matched = self.publisher.get_subscription_count()
        refused = f"{len(self.refused)} messages were refused {self.refused[-1:]}"
        return f"its publisher is at {self.number}, has {matched} subscriptions, knows of {takers}; {refused}"


@dataclass
class Size:
    """What a program took when it was first left in peace after its start."""

    pid: int
    threads: int
    descriptors: int
    bytes: int


@dataclass
class Site:
    """Everything that runs."""

    router: Router
    programs: dict[str, Program]
    links: dict[str, Link]
    ports: list[int]
    random: random.Random
    counting: Counting
    people: list[Person] = field(default_factory=list)
    steps: Counter[str] = field(default_factory=Counter)
    sizes: dict[str, Size] = field(default_factory=dict)
    largest: dict[str, int] = field(default_factory=dict)
    """Growth in bytes of a program's life at most."""
    jobs: set[asyncio.Task[None]] = field(default_factory=set)
    checks: int = 0
    longest_peace_s: float = 0.0

    @property
    def everything(self) -> dict[str, Router | Program]:
        """Each process by name."""
        return {"router": self.router, **self.programs}

    # -- what happens --

    async def step(self) -> str:
        """Let something happen; what it was."""
        deeds: list[tuple[int, Callable[[], Awaitable[str]]]] = [
            (4, self.kill),
            (3, self.freeze),
            (3, self.cut),
            (3, self.come),
            (3, self.go),
            (4, self.flood),
            (2, self.drop),
        ]
        weights = [weight for weight, _ in deeds]
        deed = self.random.choices([deed for _, deed in deeds], weights)[0]
        self.steps[deed.__name__] += 1
        return await deed()

    async def kill(self) -> str:
        """Kill -9 a program and start it again at once or a while later."""
        name = self.random.choice(list(self.everything))
        program, pause_s = self.everything[name], self.random.choice((0.0, 0.0, 0.3, 3.0))
        with suppress(AssertionError):
            await program.stop(signal.SIGKILL)
        await asyncio.sleep(pause_s)
        await program.start()
        self.sizes.pop(name, None)
        return f"kill {name}, back after {pause_s:g} s"

    async def freeze(self) -> str:
        """SIGSTOP a program for less or more than a lease."""
        name = self.random.choice(list(self.everything))
        program, pause_s = self.everything[name], self.random.choice((0.1, 0.5, 1.5, 3.5))
        program.send_signal(signal.SIGSTOP)
        await asyncio.sleep(pause_s)
        program.send_signal(signal.SIGCONT)
        return f"freeze {name} for {pause_s:g} s"

    async def cut(self) -> str:
        """Cut a program's link to the router, or hold it."""
        name = self.random.choice(list(self.links))
        link, pause_s = self.links[name], self.random.choice((0.0, 0.1, 1.0, 3.5))
        if self.random.random() < 0.7:
            link.cut()
            await asyncio.sleep(pause_s)
            link.mend()
            return f"cut {name} off for {pause_s:g} s"
        link.hold()
        await asyncio.sleep(pause_s)
        link.release()
        return f"hold the link of {name} for {pause_s:g} s"

    async def come(self) -> str:
        """Up to four headsets more, at the same time."""
        count = min(self.random.randint(1, 4), MOST_HEADSETS - len(self.people))
        coming = [self.join(self.random.randrange(len(self.ports))) for _ in range(count)]
        for failure in await asyncio.gather(*coming, return_exceptions=True):
            if isinstance(failure, BaseException) and not isinstance(failure, MacsError | OSError):
                raise failure
        return f"{count} headsets come, {len(self.people)} are here"

    async def go(self) -> str:
        """Up to four headsets less, with or without a word."""
        count = min(self.random.randint(1, 4), len(self.people) - 2)
        for _ in range(max(0, count)):
            person = self.people.pop(self.random.randrange(len(self.people)))
            await (person.headset.abort() if self.random.random() < 0.5 else person.headset.close())
        return f"{max(0, count)} headsets go, {len(self.people)} are here"

    async def drop(self) -> str:
        """All connections of one gateway end at once, and are made again."""
        gateway = self.random.randrange(len(self.ports))
        for person in self.people:
            if person.gateway == gateway:
                person.headset.drop_connection()
        return f"all headsets of gateway {gateway} lose their connection"

    async def flood(self) -> str:
        """One of the attacks, for a moment."""
        rows = [row for row in table.every().values() if row.by in ("headset", "tcp robot") and row.way is None]
        row = self.random.choice(rows)
        port, seconds = self.random.choice(self.ports), self.random.choice((0.3, 1.0, 2.0))
        words = (row.name, str(port), self.router.endpoint, str(seconds))
        attacker = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.attack.attacker", *words),
            cwd=ROOT,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        try:
            await asyncio.wait_for(attacker.wait(), BEGIN_S + seconds)
        except asyncio.TimeoutError:
            attacker.kill()
            await attacker.wait()
        return f"{row.name} for {seconds:g} s"

    async def join(self, gateway: int) -> None:
        """A headset more, which hears the topic from now on."""
        headset = await Headset.connect("127.0.0.1", self.ports[gateway], reconnect=True)
        topic = await headset.subscribe(TOPIC, "std_msgs/String", agents=[ROBOT], buffer_size=5)
        person = Person(gateway, headset, topic)
        self.people.append(person)
        self.jobs.add(asyncio.create_task(person.listen()))

    # -- what must hold --

    async def check(self) -> None:
        """Wait until all is right; AssertionError when it is not in time."""
        begin = time.monotonic()
        problem = "nothing was looked at"
        while problem:
            try:
                problem = await asyncio.wait_for(self.problem(begin), PEACE_S)
            except (MacsError, OSError, asyncio.TimeoutError) as error:
                problem = repr(error)
            assert not problem or time.monotonic() - begin < PEACE_S, problem
            await asyncio.sleep(0.1)
        self.longest_peace_s = max(self.longest_peace_s, time.monotonic() - begin)
        self.checks += 1
        for name, program in self.everything.items():
            self._check_size(name, program)

    async def problem(self, since: float) -> str:
        """What is not right now; empty when all is."""
        for name, program in self.everything.items():
            state = Path(f"/proc/{program.pid}/stat").read_text().rpartition(")")[2].split()[0]
            assert state != "Z", f"the {name} has ended: {program.log[-5:]}"
            faults = [line for line in program.log if "Traceback" in line or " E macs" in line or "panicked" in line]
            assert not faults, f"the {name} has a fault in its log: {faults[:3]}"
        for job in self.jobs:
            assert not (job.done() and not job.cancelled() and job.exception()), f"nobody listens: {job.exception()!r}"
        if lost := [p.headset.target for p in self.people if not p.headset.connected]:
            return f"{len(lost)} headsets are not connected: {lost}"
        ids = [person.headset.id for person in self.people]
        if len(set(ids)) != len(ids):
            return f"two headsets have one id: {sorted(ids)}"
        for person in {person.gateway: person for person in self.people}.values():
            online = await person.headset.online(timeout_s=3)
            if (online.ros_agent_ids, online.unity_agent_ids) != ([ROBOT], sorted(ids)):
                return f"gateway {person.gateway} says {online}, here are {sorted(ids)}"
        if deaf := [person.headset.id for person in self.people if person.heard_at < since]:
            return f"headsets {deaf} do not hear the topic; {await self.counting.sees()}"
        return await self._mesh_problem(sorted(ids))

    async def _mesh_problem(self, ids: list[int]) -> str:
        mesh = MeshSettings(connect=[self.router.endpoint])
        async with robots.operator(mesh, AgentId(OPERATOR, 7), timeout_s=5) as operator:
            seen = sorted((agent.type, agent.id) for agent in await operator.online())
            if seen != sorted([(ROS, ROBOT), *((2, each) for each in ids)]):
                return f"on the mesh are {seen}, here are {ids}"
            _, status = robots.read(await operator.ask(ROBOT, "status", timeout_s=5), RobotStatus)
        nodes = {node.name: sorted(node.registrants) for node in status.nodes if node.role != "emergency stop"}
        wanted = {TOPIC: sorted(f"unity/{each}" for each in ids)}
        return "" if nodes == wanted else f"the robot's nodes are {nodes}, wanted is {wanted}"

    def _check_size(self, name: str, program: Router | Program) -> None:
        connections = sum(self.ports[person.gateway] == _port(program) for person in self.people)
        now = Size(
            program.pid,
            threads(program.pid),
            descriptors(program.pid) - 2 * connections,  # a headset with a topic has its socket twice
            status_bytes(program.pid, "VmRSS"),
        )
        first = self.sizes.setdefault(name, now)
        assert now.threads <= first.threads + MORE_THREADS, (
            f"the {name} has {now.threads} threads, had {first.threads}"
        )
        more = now.descriptors - first.descriptors
        assert more <= MORE_DESCRIPTORS, f"the {name} has {more} descriptors more than it had"
        grown = now.bytes - first.bytes
        self.largest[name] = max(self.largest.get(name, 0), grown)
        assert grown <= MORE_BYTES, f"the {name} has grown by {grown / MIB:.0f} MiB"


def _port(program: Router | Program) -> int:
    said = program.ready.rpartition(":")[2] if isinstance(program, Program) else ""
    return int(said) if said.isdigit() else 0


@asynccontextmanager
async def site(seed: int) -> AsyncIterator[Site]:
    """A router, two gateways and a robot agent, each behind a link that can be cut, and six headsets."""
    domain = str(1 + random.SystemRandom().randrange(100))
    async with AsyncExitStack() as stack:
        router = Router(listen=[f"tcp/127.0.0.1:{free_port()}"])
        await router.start()
        stack.push_async_callback(_kill, router)
        ports = [free_port(), free_port()]
        links = {name: await stack.enter_async_context(counted(router.endpoint)) for name in ("g0", "g1", "robot")}
        programs = {
            f"g{n}": Program("gateway", "--port", str(port), "-e", links[f"g{n}"].endpoint)
            for n, port in enumerate(ports)
        }
        robot = ("agent", "--id", str(ROBOT), "-e", links["robot"].endpoint)
        programs["robot"] = Program(*robot, env={"ROS_DOMAIN_ID": domain})
        for program in programs.values():
            await program.start()
            stack.push_async_callback(_kill, program)
        counting = await stack.enter_async_context(_counting(int(domain)))
        running = Site(router, programs, links, ports, random.Random(seed), counting)
        for n in range(HEADSETS):
            await running.join(n % len(ports))
        try:
            yield running
        finally:
            for job in running.jobs:
                job.cancel()
            for person in running.people:
                await person.headset.abort()


@asynccontextmanager
async def _counting(domain: int) -> AsyncIterator[Counting]:
    """A ROS node on the robot that publishes numbers."""
    with RosSession("counter", domain_id=domain) as session:
        publisher = await session.run(lambda: session.node.create_publisher(String, TOPIC, 10))
        counting = Counting(session, publisher)
        task = asyncio.create_task(counting.count())
        try:
            yield counting
        finally:
            task.cancel()


async def _kill(program: Router | Program) -> None:
    with suppress(AssertionError, ProcessLookupError):
        program.send_signal(signal.SIGCONT)
        await program.stop(signal.SIGKILL)


async def run(minutes: float, seed: int, *, say: Callable[[str], object] = print) -> str:
    """Chaos for so long; a summary. AssertionError, with the steps before it, when something did not hold."""
    say(f"seed {seed}")
    recent: list[str] = []
    async with site(seed) as running:
        await running.check()
        begin = time.monotonic()
        while time.monotonic() - begin < 60 * minutes:
            for _ in range(running.random.randint(1, 3)):
                did = await asyncio.wait_for(running.step(), STEP_S)
                recent = [*recent[-5:], did]
                say(f"{time.monotonic() - begin:6.1f} s  {did}")
            try:
                await running.check()
            except AssertionError as error:
                logs = "\n".join(f"{name}: {line}" for name, p in running.everything.items() for line in p.log[-8:])
                raise AssertionError(f"seed {seed}, after {' · '.join(recent)}: {error}\n{logs}") from error
        grown = ", ".join(f"{name} {size / MIB:+.0f} MiB" for name, size in running.largest.items())
        steps = ", ".join(f"{name} {count}" for name, count in sorted(running.steps.items()))
        return (
            f"seed {seed}: {sum(running.steps.values())} steps ({steps}), {running.checks} times all was right, "
            f"{running.longest_peace_s:.1f} s after the last step at most; growth at most {grown}"
        )


def main() -> int:
    """From the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.attack.chaos",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(3), "little"))
    options = parser.parse_args()
    logging.getLogger("macs").setLevel(logging.ERROR)  # that connections are lost is what is done here
    print(asyncio.run(run(options.minutes, options.seed, say=lambda line: print(line, flush=True))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
