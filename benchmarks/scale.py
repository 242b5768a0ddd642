"""What agents cost a gateway by coming, registering and leaving: how the cost of each grows with their number."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

from .figures import Figure
from .plan import Case, Plan
from .processes import Program, ProgramFailed, Stage

ROBOTS = 10
NUMBERS = (50, 200, 800)
JOINS = 2000
REST_S = 0.4
"""Long enough for what follows a change to have happened; a gateway at rest takes 0.3 % of a core."""


def scale(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """A gateway's CPU for each headset that joins, registers on a topic of ten robots, and leaves, by their number."""
    router = stage.router()
    robots, _ = stage.worker("robots", router, ROBOTS)
    port = stage.gateway(router)
    gateway = next(program for program in stage.programs if program.name == "gateway")
    first: dict[str, list[float]] = {}
    addresses = (f"127.0.1.{last}" for last in itertools.count(1))  # who comes back at once is made to wait
    for number in (*NUMBERS, JOINS):
        rounds = [_round(stage, robots, gateway, port, number, next(addresses)) for _ in range(plan.rounds)]
        for what in rounds[0]:
            values = [each[what] for each in rounds]
            base = first.setdefault(what, values)
            yield Figure(f"{number} headsets {what}", values, base, f"{NUMBERS[0]} headsets", "us each", at_most=2.0)


def _round(stage: Stage, robots: Program, gateway: Program, port: int, number: int, address: str) -> dict[str, float]:
    """Microseconds of CPU that the gateway took for each headset, all from one address."""
    robots.ask("forget")
    began = gateway.used_s
    crowd, _ = stage.worker("headset", port, number, 0, "from", address)
    _wait(robots, "headsets", number)
    joined = gateway.used_s
    costs = {"join": joined - began}
    if number != JOINS:
        crowd.ask("register", robots=ROBOTS)
        _wait(robots, "registered", number * ROBOTS)
        costs["register"] = gateway.used_s - joined
    before = gateway.used_s
    crowd.stop()
    _wait(robots, "headsets", 0)
    costs["leave"] = gateway.used_s - before
    return {what: used_s * 1e6 / number for what, used_s in costs.items()}


def _wait(robots: Program, what: str, number: int) -> None:
    deadline = time.monotonic() + 30
    while (now := robots.ask("count")[what]) != number:
        if time.monotonic() > deadline:
            raise ProgramFailed(f"{now} of {number} {what}\n{robots.log_tail()}")
        time.sleep(0.02)
    time.sleep(REST_S)


CASES: dict[str, Case] = {"scale": scale}
