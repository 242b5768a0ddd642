"""Many headsets and many robots on one gateway, with everything at once: what each message takes, and what is lost."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from macs_zenoh.streams import TELL_S

from .figures import Figure
from .plan import Case, Plan
from .processes import ProgramFailed, Stage

SIZES = ((10, 5), (100, 20), (300, 30), (1000, 50))
SMALLEST = "{} x {}".format(*SIZES[0])
SECONDS = 20.0
"""How long each size is measured."""
MIXED = (20, 5)
MIXED_S, PARTS = 600.0, 5
COMMAND_MS = 3.0
"""So long 99 of 100 commands may take."""
REST_S = 0.5
LATENCIES = ("p50_ms", "p99_ms")


class Crowd:
    """A gateway with headsets, and robots on its router. ``joined_s`` is how long headsets took to be seen."""

    def __init__(self, stage: Stage, headsets: int, robots: int) -> None:
        self._number = headsets
        router = stage.router()
        self.gateway_port = stage.gateway(router)
        self.gateway = next(program for program in stage.programs if program.name == "gateway")
        self.robots, _ = stage.worker("crowd_ends", "robots", router, robots)
        self.headsets, _ = stage.worker("crowd_ends", "headsets", self.gateway_port, headsets)
        self.joined = self._counted("join", headsets=headsets)
        registered = self.headsets.ask("register", robots=robots)["registered"]
        self._wait(registered=registered)
        self.robots.ask("settle")

    def leave(self) -> Cost:
        """All headsets go."""
        return self._counted("leave", headsets=0)

    def run(self, seconds: float, *, mixed: bool = False) -> tuple[dict[str, Any], float]:
        """Everybody sends for so long: what was due and what came, by kind, and the gateway's CPU in per cent."""
        time.sleep(REST_S)
        began, used = time.monotonic(), self.gateway.used_s
        until = began + seconds
        self.robots.tell("run", until=until)
        self.headsets.tell("run", until=until, mixed=mixed)
        while time.monotonic() < until:
            time.sleep(0.1)
        percent = 100 * (self.gateway.used_s - used) / (time.monotonic() - began)
        there, here = self.robots.answer(seconds), self.headsets.answer(seconds)
        due = {**there["due"], **here["sent"]}
        came = {**there["times"], **here["times"]}
        return {kind: {"due": due[kind], "got": 0, "late": 0, **came.get(kind, {})} for kind in due}, percent

    def _counted(self, do: str, **wanted: int) -> Cost:
        began, used = time.monotonic(), self.gateway.used_s
        self.headsets.ask(do)
        took_s = self._wait(**wanted) - began
        time.sleep(REST_S)  # what follows it
        return Cost(took_s * 1e3 / self._number, (self.gateway.used_s - used) * 1e3 / self._number)

    def _wait(self, **wanted: int) -> float:
        """Until robots see so many; when that was."""
        deadline = time.monotonic() + 60
        while True:
            there, now = self.robots.ask("count"), time.monotonic()
            if all(there[what] == number for what, number in wanted.items()):
                return now
            if now > deadline:
                raise ProgramFailed(f"{there} instead of {wanted}\n{self.robots.log_tail()}")
            time.sleep(0.01)


class Cost(NamedTuple):
    """Of each headset, in ms."""

    took_ms: float
    cpu_ms: float


def crowd(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Headsets x robots: pose 100 Hz 100 B, images 30 Hz 64 KiB, commands 50 Hz together: latency, loss, CPU, MB."""
    first: dict[str, float] = {}
    for headsets, robots in SIZES:
        for name, value, unit in _measured(Crowd(stage, headsets, robots), plan):
            base = first.setdefault(name, value)
            yield Figure(name, [value], [base], SMALLEST, unit, column=f"{headsets} x {robots}")
        stage.clear()


def _measured(crowd: Crowd, plan: Plan) -> Iterator[tuple[str, float, str]]:
    kinds, percent = crowd.run(SECONDS * plan.scale)
    for kind, found in sorted(kinds.items()):
        plan.arrived(f"crowd, {kind}", found["due"], found["got"])
        for latency in LATENCIES:
            yield f"{kind} {latency.removesuffix('_ms')}", found.get(latency, math.inf), "ms"
        yield f"{kind} lost", found["due"] - found["got"], f"of {found['due']}"
        yield f"{kind} out of order", found["late"], "messages"
    yield "gateway, CPU", percent, "% of a core"
    yield "gateway, memory", crowd.gateway.memory_mb, "MB"
    yield "join", crowd.joined.took_ms, "ms each"
    yield "join, CPU", crowd.joined.cpu_ms, "ms each"
    left = crowd.leave()
    yield "leave", left.took_ms, "ms each"
    yield "leave, CPU", left.cpu_ms, "ms each"


def mixed(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Ten minutes of topics, images, commands, requests, group messages, joins and departures; is memory flat?"""
    crowd = Crowd(stage, *MIXED)
    seconds = MIXED_S * plan.scale / PARTS
    settled = 0.0
    for part in range(1, PARTS + 1):
        column = f"{part} of {PARTS}"
        kinds, percent = crowd.run(seconds, mixed=True)
        for kind, found in sorted(kinds.items()):
            plan.arrived(f"mixed, {kind}, {column}", found["due"], found["got"])
            most = 1.0 if kind == "command" else None
            p99 = [found.get("p99_ms", math.inf)]
            yield Figure(f"{kind} p99", p99, [COMMAND_MS], "limit", "ms", at_most=most, column=column)
            yield Figure(f"{kind} lost", [found["due"] - found["got"]], [0], "", f"of {found['due']}", column=column)
        memory = crowd.gateway.memory_mb
        settled = settled or memory  # until then it takes what it needs once
        yield Figure("gateway, memory", [memory], [settled], "after 1", "MB", at_most=1.05, column=column)
        yield Figure("gateway, CPU", [percent], [100.0], "a core", "%", column=column)
    time.sleep(TELL_S + REST_S)  # what was lost last the gateway knows by then, and says at its end
    if dropped := crowd.robots.ask("dropped")["dropped"]:
        plan.lost_where.append(f"robots by name: {dropped}")


CASES: dict[str, Case] = {"crowd": crowd, "mixed": mixed}
"""What needs no ROS, but minutes."""
