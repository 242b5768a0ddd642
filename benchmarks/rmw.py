"""What the way from a robot that runs rmw_zenoh to a TCP headset adds to that to a plain Zenoh subscriber, in one run;
and how much of large and of many messages arrives.

The same messages go to both. ``macs rmw-zenoh`` is beside the mesh's router, or is the robot's router itself, with the
gateway on it or on a router that it is linked with; the plain subscriber is where the gateway is.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from tests.support.programs import free_port

from .figures import Figure
from .plan import KIB, Case, Plan, in_turn
from .processes import UNLIMITED, Answer, Program, Stage
from .rmw_ends import TOPIC

HZ, SECONDS = 100.0, 8.0
ROOM_MS = 0.3
QUIET_S = 2.0
BURDENS = {"0.9 MB at 30 Hz": (900_000, 30.0, 1.0), "64 B at 2 000 Hz": (64, 2000.0, 0.99)}
"""Size, rate, and which share of them has to arrive."""


class Site(NamedTuple):
    """Who publishes, and who receives."""

    node: Program
    plain: Program
    headset: Program

    def run(self, plan: Plan, where: str) -> tuple[float, float]:
        """The medians in ms: at the headset, and at the plain subscriber."""
        count = max(50, int(HZ * SECONDS * plan.scale))
        plain, headset = self._published(KIB, HZ, count)
        plan.arrived(f"rmw, {where}", 2 * count, plain["got"] + headset["got"])
        return headset["p50_ms"], plain["p50_ms"]

    def share(self, plan: Plan, size: int, hz: float) -> float:
        """Which share of the messages the headset has."""
        count = max(50, int(hz * SECONDS * plan.scale))
        return float(self._published(size, hz, count)[1]["got"] / count)

    def _published(self, size: int, hz: float, count: int) -> list[Answer]:
        """What the plain subscriber and the headset have of so many."""
        for receiver in (self.plain, self.headset):
            receiver.tell("collect", count=count, quiet_s=QUIET_S)
        self.node.ask("publish", size=size, hz=hz, count=count)
        return [receiver.answer() for receiver in (self.plain, self.headset)]


def _site(stage: Stage, *, own_router: bool, linked: bool) -> Site:
    mesh = stage.router() if linked or not own_router else 0
    arguments = ["-m", "bridge", "rmw-zenoh", "--id", "1", "--settings", str(UNLIMITED)]
    robot = mesh
    if own_router:
        robot = free_port()
        arguments += ["--mode", "router", "-l", f"tcp/127.0.0.1:{robot}"]
    if mesh:
        arguments += ["-e", f"tcp/127.0.0.1:{mesh}"]
    stage._start("rmw-zenoh", *arguments).line()
    where = mesh or robot
    gateway = stage.gateway(where)
    node, _ = stage.worker("rmw_ends", "publish", robot)
    plain, _ = stage.worker("rmw_ends", "take", where)
    headset, _ = stage.worker("robot_ends", "headset", gateway, 1)
    time.sleep(1.5)
    headset.ask("register", topic=TOPIC, kind=1, buffer=1000)
    time.sleep(1.0)
    return Site(node, plain, headset)


def rmw(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """1 KiB at 100 Hz of a robot without ROS to a TCP headset, against a plain Zenoh subscriber and 0.3 ms."""
    sites = {
        "beside the router": _site(stage, own_router=False, linked=False),
        "the robot's router": _site(stage, own_router=True, linked=False),
        "the robot's router, linked": _site(stage, own_router=True, linked=True),
    }
    plain: dict[str, list[float]] = {name: [] for name in sites}

    def once(name: str) -> float:
        at_headset, at_plain = sites[name].run(plan, name)
        plain[name].append(at_plain)
        return at_headset

    def run(name: str) -> Any:
        return lambda: once(name)

    values = in_turn(plan.rounds, {name: run(name) for name in sites})
    for name, found in values.items():
        room = [each + ROOM_MS for each in plain[name]]
        yield Figure(f"{name}, p50", found, room, f"plain + {ROOM_MS:g} ms", "ms", at_most=1.0)
        yield Figure(f"plain Zenoh there, p50 ({name})", plain[name], room, "the same with room", "ms")
    site = sites["beside the router"]
    for name, (size, hz, least) in BURDENS.items():
        shares = [site.share(plan, size, hz) for _ in range(plan.rounds)]
        yield Figure(f"{name}, arrived", shares, [1.0] * len(shares), "all", "", at_least=least)


CASES: dict[str, Case] = {"rmw": rmw}
