"""What traces cost a robot's topic from a session through a router to another one: off, one in a hundred, and all."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

from .figures import Figure
from .plan import KIB, QUIET_S, Case, Plan, in_turn
from .processes import Program, ProgramFailed, Stage

EVERY = 100
SIZES = {"64 B": 64, "1 KiB": KIB}
OFF, SPARSE = 0.99, 0.98
"""What is left of the throughput at least: while nobody asks, and with one in a hundred traced."""


def _rate(
    plan: Plan, where: str, sender: Program, receiver: Program, size: int, used: list[float] | None = None
) -> float:
    """Messages a second. ``used`` gets the processor time of both ends, in us for each message."""
    count = plan.count(size)
    receiver.ask("expect", count=count)
    before = sender.used_s + receiver.used_s
    began = sender.ask("put", size=size, count=count)["began"]
    got = receiver.ask("receive", timeout_s=QUIET_S)
    if used is not None:
        used.append((sender.used_s + receiver.used_s - before) / count * 1e6)
    return count / (got["ended"] - began) if plan.arrived(where, count, got["received"]) else 0.0


def traces(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """A topic's messages a second: untraced twice, after a trace has ended, with one in a hundred traced, with all."""
    pairs = {}
    for name, every in {"never": 0, "never again": 0, "ended": 0, "one in 100": EVERY, "all": 1}.items():
        router = stage.router()
        receiver, _ = stage.worker("trace_ends", "take", router, every)
        sender, _ = stage.worker("trace_ends", "put", router, every)
        pairs[name] = (sender, receiver)
        _wait(name, sender, receiver)
    for end in pairs["ended"]:
        end.ask("ask", seconds=30)
    _rate(plan, "ended", *pairs["ended"], 64)
    for end in pairs["ended"]:
        if end.ask("end")["wanted"]:
            raise ProgramFailed("a trace does not end")
    for label, size in SIZES.items():
        used: dict[str, list[float]] = {name: [] for name in pairs}
        runs = {
            name: partial(_rate, plan, f"{name}, {label}", *pair, size, used[name]) for name, pair in pairs.items()
        }
        rates = in_turn(plan.rounds, runs)
        told = partial(Figure, baseline=rates["never"], against="never traced", unit="msg/s", column=label)
        yield told("the same once more", rates["never again"])
        yield told("a trace has ended", rates["ended"], at_least=OFF)
        yield told("one in 100 traced", rates["one in 100"], at_least=SPARSE)
        yield told("all traced", rates["all"])
        costs = partial(
            Figure, baseline=used["never"], against="never traced", unit="us of processor a message", column=label
        )
        yield costs("processor: the same once more", used["never again"])
        yield costs("processor: a trace has ended", used["ended"], at_most=1 / OFF)
        yield costs("processor: one in 100 traced", used["one in 100"], at_most=1 / SPARSE)
        took = pairs["never"][0].ask("look")["took"]
        each = [1 / rate for rate in rates["never"] if rate]
        yield Figure(
            "the look whether to trace", [took] * len(each), each, "a message", "s", at_most=1 - OFF, column=label
        )


def _wait(name: str, sender: Program, receiver: Program) -> None:
    for _ in range(50):
        receiver.ask("expect", count=1)
        sender.ask("put", size=1, count=1)
        if receiver.ask("receive", timeout_s=0.2)["received"]:
            time.sleep(0.1)
            return
    raise ProgramFailed(f"{name}: nothing arrives")


CASES: dict[str, Case] = {"traces": traces}
