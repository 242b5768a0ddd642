"""Messages of which none is like the one before, to destinations in turn, each counted: nothing may be lost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from .cases import RawZenoh, rate, size_text
from .figures import Figure
from .plan import KIB, MIB, QUIET_S, RELAYS, Plan, Run, in_rotation, in_turn
from .processes import Program, ProgramFailed, Stage

SIZES = (64, KIB, 64 * KIB)


class Line(NamedTuple):
    """A sender and the worker that receives, on some path."""

    path: str
    sender: Program
    receiver: Program
    ids: list[int]

    def ways(self, each: bool) -> list[dict[str, list[int]]]:
        """One destination after the other, or all in every message."""
        if each:
            return [{"ids": [one], "groups": []} for one in self.ids]
        return [{"ids": self.ids, "groups": []}]


def connect(stage: Stage, path: str, from_port: int, to_port: int, receivers: int) -> Line:
    """Two workers that have seen each other."""
    receiver, there = stage.worker("headset", to_port, receivers, 0)
    sender, _ = stage.worker("headset", from_port, 1, 0)
    line = Line(path, sender, receiver, there["ids"])
    for _ in range(10):
        totals = sender.ask("prepare", size=64, count=receivers, ways=line.ways(each=True))["bytes"]
        receiver.tell("receive_sequence", totals=totals, timeout_s=1)
        sender.ask("send_prepared")
        if receiver.answer()["received"] == [1] * receivers:
            return line
    raise ProgramFailed(f"{path}: nothing arrives\n{receiver.log_tail()}")


def run_of(plan: Plan, line: Line, size: int, *, each: bool) -> Run:
    """Messages per second that reach all receivers together, each once and in order."""
    everybody = len(line.ids)
    ways = line.ways(each)
    copies = 1 if each else everybody
    count = plan.count(size, copies) // len(ways) * len(ways)
    totals = line.sender.ask("prepare", size=size, count=count, ways=ways)["bytes"]
    where = f"{line.path}, {everybody} receivers{' in turn' if each else ''}, {size_text(size)}"

    def run() -> float:
        line.receiver.tell("receive_sequence", totals=totals if each else totals * everybody, timeout_s=QUIET_S)
        began = line.sender.ask("send_prepared")["began"]
        return _judge(plan, where, count * copies, line.receiver.answer(), began)

    return run


def _judge(plan: Plan, where: str, expected: int, there: dict[str, list[int]], began: float) -> float:
    got, late = sum(there["received"]), sum(there["out_of_order"])
    if late:
        plan.lost_where.append(f"{where}: {late} out of order")
        plan.lost += late
    whole = plan.arrived(where, expected, got)
    return got / (there["ended"] - began) if whole and not late else 0.0  # type: ignore[operator]


def differing(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Number, request id and length differ in each message, to one headset, two in turn, ten."""
    router = stage.router()
    near, far = stage.gateway(router), stage.gateway(router)
    relays = [stage.relay() for _ in range(RELAYS)]
    gateway = next(program for program in stage.programs if program.name == "gateway")
    plain_relays = [program for program in stage.programs if program.name == "relay"]
    paths = {"one gateway": (near, near), "two gateways": (near, far)}
    zenoh = RawZenoh.start(stage, router, direct=False)
    for receivers, each, sizes in ((1, False, SIZES), (2, True, SIZES), (10, False, (64, 64 * KIB, MIB))):
        plain = [connect(stage, "relay", port, port, receivers) for port in relays]
        lines = [connect(stage, path, *ports, receivers) for path, ports in paths.items()]
        for size in sizes:
            used: dict[str, list[float]] = {"relay": [], "one gateway": []}
            runs = {"relay": in_rotation([run_of(plan, line, size, each=each) for line in plain])}
            runs |= {line.path: run_of(plan, line, size, each=each) for line in lines}
            runs["relay"] = _costed(runs["relay"], plain_relays, used["relay"])
            runs["one gateway"] = _costed(runs["one gateway"], [gateway], used["one gateway"])
            if receivers == 1:
                runs["raw Zenoh"] = zenoh.run(plan, size, plan.count(size))
            values = in_turn(plan.rounds, runs)
            baseline, raw = values.pop("relay"), values.pop("raw Zenoh", None)
            for path, rates in values.items():
                name = f"differing, 1 to {receivers}{' in turn' if each else ''}, {path}, {size_text(size)}"
                bound = 0.9 if path == "one gateway" else None
                yield rate(name, size, rates, baseline, "plain relay", at_least=bound)
                if raw is not None:
                    yield rate(name, size, rates, raw, "raw Zenoh")
                if path in used:
                    each_us = 1e6 / plan.count(size, 1 if each else receivers)
                    costs, least = ([one * each_us for one in used[which]] for which in (path, "relay"))
                    yield Figure(f"{name}, processor", costs, least, "plain relay", "us each")
        for line in (*plain, *lines):
            line.sender.stop()
            line.receiver.stop()
    robot, alone = robot_line(stage, near), connect(stage, "headset", near, near, 1)
    for size in SIZES:
        runs = {"robot": robot_run(plan, robot, size), "headset": run_of(plan, alone, size, each=False)}
        values = in_turn(plan.rounds, runs)
        name = f"differing, robot program to headset, {size_text(size)}"
        yield rate(name, size, values["robot"], values["headset"], "headset to headset")


def _costed(run: Run, programs: Sequence[Program], used: list[float]) -> Run:
    """The same, and how many seconds of a processor these took: what does not depend on who else is at the machine."""

    def costed() -> float:
        before = sum(program.used_s for program in programs)
        value = run()
        used.append(sum(program.used_s for program in programs) - before)
        return value

    return costed


def robot_line(stage: Stage, port: int) -> Line:
    """A robot program over TCP, and a headset that registered on its topic."""
    robot, here = stage.worker("headset", port, 1, 0, "robot")
    receiver, there = stage.worker("headset", port, 1, 0)
    receiver.ask("register", ids=here["ids"])
    for _ in range(20):
        total = robot.ask("prepare_topic", size=64, count=1, to=there["ids"])["bytes"]
        receiver.tell("receive_sequence", totals=[total], timeout_s=0.5)
        robot.ask("send_prepared")
        if receiver.answer()["received"] == [1]:
            return Line("robot program", robot, receiver, there["ids"])
    raise ProgramFailed(f"no topic data of a robot program arrives\n{receiver.log_tail()}")


def robot_run(plan: Plan, line: Line, size: int) -> Run:
    """Topic messages per second, each once and in order."""
    count = plan.count(size)
    total = line.sender.ask("prepare_topic", size=size, count=count, to=line.ids)["bytes"]

    def run() -> float:
        line.receiver.tell("receive_sequence", totals=[total], timeout_s=QUIET_S)
        began = line.sender.ask("send_prepared")["began"]
        return _judge(plan, f"{line.path}, {size_text(size)}", count, line.receiver.answer(), began)

    return run


CASES = {"differing": differing}
