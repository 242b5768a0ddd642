"""What a robot agent costs against plain rclpy, in one run.

Plain: a publisher and a raw subscription in two processes. Ours: the same publisher → robot agent → router → gateway
→ TCP headset, and back; each a process of its own. The targets leave the plain way some room: so many ms are added to
what it took in the same round.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

from .figures import Figure
from .plan import KIB, Case, Plan, Run, in_turn
from .processes import UNLIMITED, Program, ProgramFailed, Stage
from .robot_ends import stamped

IMAGE = 900_000
QUIET_S = 2.0
CPU_LATENCY = "/dev/cpu_dma_latency"
"""While it is open, cores sleep no more deeply than was written to it: zeros for not at all."""
WITHOUT_US = ("plain", "to topic, bare")
"""The ways that no program of ours takes part in, but for the router: they say what a machine can do."""
RATES = (500, 1000, 1500, 2000, 2500, 3000, 3500, 4000, 5000, 6000)
IDLE_S = 10.0


class Room(NamedTuple):
    """What the way through a robot agent may take: so much of what plain rclpy takes, and so many ms more."""

    factor: float
    ms: float

    def __str__(self) -> str:
        return f"{'' if self.factor == 1 else f'x {self.factor:g} '}+ {self.ms:g} ms"


Ways = Sequence[str]


class Site:
    """Everything that runs, and the topics in it: ``/plain`` has no robot agent, ``/robot`` and ``/command`` do."""

    def __init__(self, stage: Stage, *, awake: bool = False) -> None:
        self._awake = awake
        os.environ.setdefault("ROS_DOMAIN_ID", str(50 + os.getpid() % 50))
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        router = stage.router()
        gateway = stage.gateway(router)
        arguments = ("-m", "bridge", "agent", "--id", "1", "-e", f"tcp/127.0.0.1:{router}")
        self.agent = stage._start("agent", *arguments, "--settings", str(UNLIMITED))
        self.agent.line()
        self.publisher, _ = stage.worker("robot_ends", "ros")
        self.subscriber, _ = stage.worker("robot_ends", "ros")
        self.headset, _ = stage.worker("robot_ends", "headset", gateway, 1)
        self.five, _ = stage.worker("robot_ends", "headset", gateway, 5)
        _, bare = stage.worker("bare", "gateway", router, len(stamped(KIB)))
        stage.worker("bare", "robot", router, "/bare")
        self.bare, _ = stage.worker("bare", "headset", bare["port"])
        self.depth = 1000  # a machine that others use stalls for tens of ms: that is not what is measured
        self.subscriber.ask("subscribe", topic="/plain", depth=self.depth)
        self.publisher.ask("advertise", topic="/plain", depth=self.depth, matched=1)
        time.sleep(1.0)
        self.headset.ask("register", topic="/robot", kind=1, buffer=self.depth)
        self.publisher.ask("advertise", topic="/robot", depth=self.depth, matched=1)
        self.five.ask("register", topic="/five", kind=1, buffer=self.depth)
        self.publisher.ask("advertise", topic="/five", depth=self.depth, matched=1)
        for topic in ("/command", "/bare"):
            self.subscriber.ask("subscribe", topic=topic, depth=self.depth)
        time.sleep(0.5)
        self.headset.ask("register", topic="/command", kind=2, buffer=self.depth)
        time.sleep(1.5)

    def run(self, path: str, size: int, hz: float, seconds: float) -> dict[str, Any]:
        """Send on a path at a rate: how many were sent and arrived, and the latencies there."""
        sender, receiver, topic = self.ends(path)
        count = max(10, int(hz * seconds))
        with self._cores_awake():
            receiver.tell("collect", count=count, quiet_s=QUIET_S + size / 1e6)
            took = sender.ask("publish", topic=topic, size=size, hz=hz, count=count)
            answer = receiver.answer()
        return {**answer, "sent": count, "lost": count - answer["got"], "hz": count / max(took["took_s"], 1e-9)}

    def ends(self, path: str) -> tuple[Program, Program, str]:
        """Who sends and who receives on a path, and its topic."""
        return {
            "plain": (self.publisher, self.subscriber, "/plain"),
            "to headset": (self.publisher, self.headset, "/robot"),
            "to five": (self.publisher, self.five, "/five"),
            "to topic": (self.headset, self.subscriber, "/command"),
            "to topic, bare": (self.bare, self.subscriber, "/bare"),
        }[path]

    @contextmanager
    def _cores_awake(self) -> Iterator[None]:
        """Linux lets no core sleep while the device is open, on every path."""
        if not self._awake:
            yield
            return
        try:
            request = open(CPU_LATENCY, "wb", buffering=0)  # noqa: PTH123, SIM115 - closed below
        except OSError as error:
            raise ProgramFailed(f"cores cannot be kept awake: {error}") from error
        with request:
            request.write(bytes(4))
            yield


def latencies(
    site: Site, plan: Plan, what: str, size: int, hz: float, seconds: float, *, rounds: int, room: Room, ways: Ways
) -> Iterator[Figure]:
    """The median on each way, against the plain one with its room."""

    def run(path: str) -> Run:
        def once() -> float:
            figures = site.run(path, size, hz, seconds)
            plan.arrived(f"robot, {path}, {what}", figures["sent"], figures["got"])
            return float(figures["p50_ms"])

        return once

    values = in_turn(rounds, {path: run(path) for path in ("plain", *ways)})
    baseline = [room.factor * plain + room.ms for plain in values["plain"]]
    for path in ways:
        most = 1.0 if path not in WITHOUT_US else None
        yield Figure(f"ROS {path}, {what}, p50", values[path], baseline, f"rclpy {room}", "ms", at_most=most)
    yield Figure(f"plain rclpy, {what}, p50", values["plain"], baseline, "the same with room", "ms")


def highest_rate(site: Site, path: str, seconds: float) -> float:
    """The highest rate at 1 KiB that the sender reaches and of which at most 1 % is lost."""
    best = 0.0
    for hz in RATES:
        run = min((site.run(path, KIB, hz, seconds) for _ in range(2)), key=lambda run: run["lost"])
        if run["lost"] > run["sent"] / 100:
            break
        best = run["hz"]
        if run["hz"] < hz * 0.95:  # the sender cannot do more
            break
    return best


def idle(agent: Program) -> dict[str, float]:
    """What the agent needs while nothing is sent: share of one core, MB resident."""

    before = agent.used_s
    time.sleep(IDLE_S)
    return {"cpu_percent": 100 * (agent.used_s - before) / IDLE_S, "mb": agent.memory_mb}


# -- cases ---------------------------------------------------------------------------------------------------------


def robot(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """A ROS topic of 1 KiB at 100 Hz to one headset and to five, and a headset's commands, against plain rclpy."""
    yield from small(Site(stage), plan, "1 KiB, 100 Hz")


def robot_awake(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """The same on cores that are kept awake. Needs the right to do so."""
    yield from small(Site(stage, awake=True), plan, "1 KiB, 100 Hz, awake")


def small(site: Site, plan: Plan, what: str) -> Iterator[Figure]:
    """Small messages one by one, on every way."""
    ways = ("to headset", "to topic", "to topic, bare", "to five")
    yield from latencies(site, plan, what, KIB, 100, 3, rounds=plan.rounds, room=Room(1, 0.6), ways=ways)


def robot_large(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """64 KiB at 200 Hz and 0.9 MB at 30 Hz through a robot agent, 20 s each (5 s if quick), against plain rclpy."""
    site, seconds = Site(stage), 20 * plan.scale
    for what, size, hz in (("64 KiB, 200 Hz", 64 * KIB, 200), ("0.9 MB, 30 Hz", IMAGE, 30)):
        ways = ("to headset", "to topic")
        yield from latencies(site, plan, what, size, hz, seconds, rounds=1, room=Room(1.2, 1), ways=ways)


def robot_rate(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """The highest rate of 1 KiB through a robot agent of which at most 1 % is lost, against plain rclpy."""
    site = Site(stage)
    rounds = max(1, plan.rounds // 2)
    paths = ("plain", "to headset", "to topic")
    values = in_turn(rounds, {path: partial(highest_rate, site, path, 2.0) for path in paths})
    for path in paths[1:]:
        yield Figure(f"ROS {path}, 1 KiB, rate", values[path], values["plain"], "rclpy", "msg/s", at_least=0.9)


def robot_idle(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """What a robot agent needs while nothing is sent."""
    used = idle(Site(stage).agent)
    yield Figure("idle robot agent, CPU", [used["cpu_percent"]], [2.0], "limit", "% of a core", at_most=1.0)
    yield Figure("idle robot agent, memory", [used["mb"]], [90.0], "limit", "MB", at_most=1.0)


CASES: dict[str, Case] = {
    "robot": robot,
    "robot-awake": robot_awake,
    "robot-large": robot_large,
    "robot-rate": robot_rate,
    "robot-idle": robot_idle,
}
"""What needs rclpy, by its name on the command line."""
