"""The cases: which programs are started, what is sent, what is set against what, and the targets.

The targets are those that the project has set itself; a line without one is there to understand the others.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from statistics import median
from typing import NamedTuple

from macs_zenoh.protocol.wire import MACS

from .figures import Figure
from .link import CountingLink
from .plan import KIB, LATE_S, MIB, QUIET_S, RELAYS, Case, Plan, Run, in_rotation, in_turn
from .processes import Program, ProgramFailed, Stage


class Pair(NamedTuple):
    """A headset that sends and the worker that receives, on some path."""

    path: str
    sender: Program
    receiver: Program
    sender_id: int
    receiver_ids: list[int]
    group: int = 0
    """The receivers' own; messages go to it instead of to their ids, unless it is 0."""
    overhead_bytes: int = 0
    """What arrives per message besides the message."""

    @property
    def to(self) -> dict[str, list[int]]:
        """The destination of every message."""
        return {"ids": [], "groups": [self.group]} if self.group else {"ids": self.receiver_ids, "groups": []}


# -- paths ---------------------------------------------------------------------------------------------------------


def connect(stage: Stage, path: str, from_port: int, to_port: int, receivers: int = 1, group: int = 0) -> Pair:
    """Two workers on a path, which is then known to carry messages whole."""
    receiver, there = stage.worker("headset", to_port, receivers, group)
    sender, here = stage.worker("headset", from_port, 1, 0)
    return proved(Pair(path, sender, receiver, here["ids"][0], there["ids"], group))


def proved(pair: Pair) -> Pair:
    """Send until something arrives, as agents need a moment to see each other; then compare every byte."""
    everybody = len(pair.receiver_ids)
    length = pair.sender.ask("message_bytes", size=1)["message_bytes"]
    for _ in range(10):
        pair.receiver.tell("receive", total_bytes=length, timeout_s=1)
        pair.sender.ask("send", size=1, count=1, **pair.to)
        if pair.receiver.answer()["bytes"] == [length] * everybody:
            break
    else:
        raise ProgramFailed(f"{pair.path}: nothing arrives\n{pair.receiver.log_tail()}")
    pair.receiver.ask("receive", total_bytes=MIB, timeout_s=0.3)  # what was sent too early and arrives all the same
    for size in (0, 64, 64 * KIB, 3 * MIB):
        pair.receiver.tell("check", size=size, count=2)
        pair.sender.ask("send", size=size, count=2, **pair.to)
        good = pair.receiver.answer()["good"]
        if good != 2 * everybody:
            raise ProgramFailed(f"{pair.path}: {good} of {2 * everybody} messages of {size} bytes arrived whole")
    return pair


def stream(plan: Plan, pair: Pair, size: int) -> Run:
    """Messages per second that reach all receivers together."""
    everybody = len(pair.receiver_ids)
    count = plan.count(size, everybody)
    length = pair.sender.ask("message_bytes", size=size)["message_bytes"] + pair.overhead_bytes

    def run() -> float:
        pair.receiver.tell("receive", total_bytes=count * length, timeout_s=QUIET_S)
        began = pair.sender.ask("send", size=size, count=count, **pair.to)["began"]
        there = pair.receiver.answer()
        where, got = f"{pair.path}, {size_text(size)}", sum(received // length for received in there["bytes"])
        late = 0
        if got < count * everybody:  # what still comes is not lost, and belongs to no other round
            pair.receiver.tell("receive", total_bytes=count * length, timeout_s=LATE_S)
            later = pair.receiver.answer(LATE_S)["bytes"]
            late = sum((a + b) // length for a, b in zip(there["bytes"], later, strict=True)) - got
        whole = plan.arrived(where, count * everybody, got, late)
        return float(got / (there["ended"] - began)) if whole else 0.0

    return run


class RawZenoh(NamedTuple):
    """Publisher and subscriber of the baseline, each a process."""

    publisher: Program
    subscriber: Program
    key: str

    @classmethod
    def start(cls, stage: Stage, router: int, *, direct: bool) -> RawZenoh:
        """Two sessions on a router; ``direct`` is Zenoh's other callback kind."""
        key = f"bench/{'direct' if direct else 'default'}"
        raw = cls(stage.worker("raw", "zenoh", router)[0], stage.worker("raw", "zenoh", router)[0], key)
        raw.subscriber.ask("subscribe", key=key, direct=direct)
        for _ in range(50):
            raw.subscriber.ask("expect", count=1)
            raw.publisher.ask("publish", key=key, size=1, count=1)
            if raw.subscriber.ask("receive", timeout_s=0.1)["received"]:
                return raw
        raise ProgramFailed("raw Zenoh: nothing arrives")

    def run(self, plan: Plan, size: int, count: int) -> Run:
        """Samples per second."""

        def run() -> float:
            self.subscriber.ask("expect", count=count)
            began = self.publisher.ask("publish", key=self.key, size=size, count=count)["began"]
            there = self.subscriber.ask("receive", timeout_s=QUIET_S)
            whole = plan.arrived(f"raw Zenoh, {size_text(size)}", count, there["received"])
            return float(count / (there["ended"] - began)) if whole else 0.0

        return run


# -- cases ---------------------------------------------------------------------------------------------------------


def ends(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """What the measuring ends cost themselves: a headset's sender joined to a receiver, against the plain relay."""
    sink, listening = stage.worker("headset", "sink")
    sink.tell("accept")
    sender, here = stage.worker("headset", listening["port"], 1, 0)
    sink.answer()
    direct = Pair("ends", sender, sink, here["ids"][0], [1], overhead_bytes=MACS.header_bytes)
    port = stage.relay()
    relayed = connect(stage, "relay", port, port)
    for size in (64, KIB, 64 * KIB, MIB):
        values = in_turn(plan.rounds, {"direct": stream(plan, direct, size), "relay": stream(plan, relayed, size)})
        yield rate(f"ends joined, {size_text(size)}", size, values["direct"], values["relay"], "plain relay")


def through(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Headset to headset, over one gateway and over two, against raw Zenoh publish to subscribe through one router."""
    router = stage.router()
    near, far = stage.gateway(router), stage.gateway(router)
    pairs = {"one gateway": connect(stage, "one gateway", near, near)}
    pairs["two gateways"] = connect(stage, "two gateways", near, far)
    default, direct = (RawZenoh.start(stage, router, direct=kind) for kind in (False, True))
    for size in (64, KIB, 64 * KIB):
        count = plan.count(size)
        frame = size + MACS.header_bytes + pairs["one gateway"].sender.ask("message_bytes", size=0)["message_bytes"]
        runs = {
            "default": default.run(plan, size, count),
            "direct": direct.run(plan, size, count),
            "frame": default.run(plan, frame, count),
            **{path: stream(plan, pair, size) for path, pair in pairs.items()},
        }
        values = in_turn(plan.rounds, runs)
        for path in pairs:
            name = f"1 to 1, {path}, {size_text(size)}"
            yield rate(name, size, values[path], values["default"], "raw Zenoh", at_least=0.6)
            yield rate(name, size, values[path], values["direct"], "raw Zenoh, direct callback")
            yield rate(name, size, values[path], values["frame"], f"raw Zenoh, {frame} B")


def latency(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """There and back at 1 KiB, one message at a time, against raw Zenoh's round trip plus TCP's.

    To an agent on the mesh the way is one of each; to a headset on another gateway it is one Zenoh and two TCP ways.
    """
    size, count = KIB, max(200, int(1500 * plan.scale))
    router = stage.router()
    near, far = stage.gateway(router), stage.gateway(router)
    pairs = [connect(stage, "one gateway", near, near), connect(stage, "two gateways", near, far)]
    zenoh = _raw_zenoh_round_trip(stage, plan, router, size, count)
    tcp = _raw_tcp_round_trip(stage, plan, size, count)
    runs = {f"headset to headset, {pair.path}": measured_round_trip(plan, pair, size, count) for pair in pairs}
    runs["headset to agent"] = _agent_round_trip(stage, plan, router, near, size, count)
    values = in_turn(plan.rounds, {"zenoh": zenoh, "tcp": tcp, **runs})
    both = [a + b for a, b in zip(values["zenoh"], values["tcp"], strict=True)]
    for path in runs:
        yield Figure(f"{path}, {size_text(size)}", values[path], both, "raw Zenoh + raw TCP", "us", at_most=1.5)
    yield Figure("round trip, raw Zenoh", values["zenoh"], values["tcp"], "raw TCP", "us")


def measured_round_trip(plan: Plan, pair: Pair, size: int, count: int) -> Run:
    """The median time of a message and its answer, in µs."""
    length = {
        "there": pair.sender.ask("message_bytes", size=size)["message_bytes"],
        "back": pair.receiver.ask("message_bytes", size=size)["message_bytes"],
    }
    padding = length["there"] - length["back"]  # ids have more or fewer digits: let both directions be as long

    def run() -> float:
        pair.receiver.tell("echo", size=size + padding, count=count, to=pair.sender_id, message_bytes=length["there"])
        times = pair.sender.ask(
            "ping", size=size, count=count, to_type=2, to=pair.receiver_ids[0], answer_bytes=length["there"]
        )["times"]
        pair.receiver.answer()
        whole = plan.arrived(f"round trip, {pair.path}", count, len(times))
        return float(median(times)) * 1e6 if whole else math.inf

    return run


def _agent_round_trip(stage: Stage, plan: Plan, router: int, gateway: int, size: int, count: int) -> Run:
    robot, _ = stage.worker("robot", router)
    headset, _ = stage.worker("headset", gateway, 1, 0)
    length = robot.ask("answer_bytes", size=size)["answer_bytes"]

    def run() -> float:
        times = headset.ask("ping", size=size, count=count, to_type=1, to=1, answer_bytes=length)["times"]
        whole = plan.arrived("round trip, headset to agent", count, len(times))
        return float(median(times)) * 1e6 if whole else math.inf

    return run


def _raw_zenoh_round_trip(stage: Stage, plan: Plan, router: int, size: int, count: int) -> Run:
    near, far = (stage.worker("raw", "zenoh", router)[0] for _ in range(2))
    far.ask("echo")
    time.sleep(0.5)  # Zenoh tells nobody when a subscription has reached the other side; the warm-up below would say

    def run() -> float:
        near.ask("ping", size=size, count=10)
        times = near.ask("ping", size=size, count=count)["times"]
        whole = plan.arrived("round trip, raw Zenoh", count, len(times))
        return float(median(times)) * 1e6 if whole else math.inf

    return run


def _raw_tcp_round_trip(stage: Stage, plan: Plan, size: int, count: int) -> Run:
    far, listening = stage.worker("raw", "tcp")
    near, _ = stage.worker("raw", "tcp", listening["port"])

    def run() -> float:
        far.tell("echo", size=size, count=count)
        times = near.ask("ping", size=size, count=count)["times"]
        far.answer()
        whole = plan.arrived("round trip, raw TCP", count, len(times))
        return float(median(times)) * 1e6 if whole else math.inf

    return run


def large(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Headset to headset at 1 MiB and 20 MiB, against the plain relay."""
    yield from _against_relay(stage, plan, (MIB, 20 * MIB), receivers=1)


def fanout(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """One headset to ten, by ids and by group, against the plain relay."""
    yield from _against_relay(stage, plan, (64, 64 * KIB, MIB), receivers=10)


def _against_relay(stage: Stage, plan: Plan, sizes: Iterable[int], receivers: int) -> Iterator[Figure]:
    router = stage.router()
    near, far = stage.gateway(router), stage.gateway(router)
    relays = [stage.relay() for _ in range(RELAYS)]
    paths = {"one gateway": (near, near), "two gateways": (near, far)}
    for way in [""] if receivers == 1 else [" by id", " by group"]:
        by_group = int(way == " by group")
        plain = [connect(stage, f"relay{way}", port, port, receivers, by_group) for port in relays]
        pairs = [
            connect(stage, f"{path}{way}", *ports, receivers, number * by_group)  # neither is in the other's group
            for number, (path, ports) in enumerate(paths.items(), 1)
        ]
        for size in sizes:
            runs = {"relay": in_rotation([stream(plan, each, size) for each in plain])}
            values = in_turn(plan.rounds, runs | {each.path: stream(plan, each, size) for each in pairs})
            baseline = values.pop("relay")
            for path, rates in values.items():
                yield rate(
                    f"1 to {receivers}, {path}, {size_text(size)}",
                    size,
                    rates,
                    baseline,
                    "plain relay",
                    at_least=0.7 if path.startswith("one") else None,
                )
        for each in (*plain, *pairs):
            each.sender.stop()
            each.receiver.stop()


def uplink(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Bytes on a robot's link per topic message, with 1, 10 and 50 headsets registered, against one frame."""
    size, count = 64 * KIB, max(10, int(50 * plan.scale))
    router = stage.router()
    gateways = [stage.gateway(router), stage.gateway(router)]
    link = CountingLink(router)
    robot, _ = stage.worker("robot", link.port)
    workers: list[tuple[Program, int]] = []
    for receivers, ports in ((1, gateways[:1]), (10, gateways[:1]), (10, gateways), (50, gateways)):
        here = sum(already for _, already in workers)
        wanted = receivers - here if len(ports) == 1 or receivers > here else 0
        for port in ports if wanted else []:
            worker, _ = stage.worker("headset", port, wanted // len(ports), 0)
            worker.ask("register")
            workers.append((worker, wanted // len(ports)))
        _await_registrants(robot, receivers)
        yield _uplink(plan, robot, link, workers, size, count, len(ports))
    link.close()


def _await_registrants(robot: Program, wanted: int) -> None:
    deadline = time.monotonic() + 10
    while robot.ask("count")["registrants"] != wanted:
        if time.monotonic() > deadline:
            raise ProgramFailed(f"uplink: not {wanted} registrations reached the robot\n{robot.log_tail()}")
        time.sleep(0.05)


def _uplink(
    plan: Plan, robot: Program, link: CountingLink, workers: list[tuple[Program, int]], size: int, count: int, on: int
) -> Figure:
    receivers = sum(number for _, number in workers)
    warm = robot.ask("publish", size=size, count=0, pause_s=0)
    length = warm["message_bytes"]
    for worker, _ in workers:
        worker.tell("receive", total_bytes=count * length, timeout_s=QUIET_S)
    before = link.sent
    robot.ask("publish", size=size, count=count, pause_s=0.02)
    got = sum(received // length for worker, _ in workers for received in worker.answer()["bytes"])
    plan.arrived(f"uplink, {receivers} receivers", count * receivers, got)
    per_message = (link.sent - before) / count
    where = "one gateway" if on == 1 else f"{on} gateways"
    name = f"robot's uplink, {receivers} headsets on {where}"
    return Figure(name, [per_message], [warm["frame_bytes"]], "one frame", "B/message", at_most=1.05)


CASES: dict[str, Case] = {
    "ends": ends,
    "through": through,
    "latency": latency,
    "uplink": uplink,
    "large": large,
    "fanout": fanout,
}
"""What needs no ROS, by its name on the command line."""


def rate(
    name: str, size: int, subject: list[float], baseline: list[float], against: str, *, at_least: float | None = None
) -> Figure:
    """Rates as people read them: messages for small sizes, MB of data for large ones."""
    if size < 64 * KIB:
        return Figure(name, subject, baseline, against, "msg/s", at_least=at_least)
    mb = size / 1e6
    return Figure(name, [v * mb for v in subject], [v * mb for v in baseline], against, "MB/s", at_least=at_least)


def size_text(size: int) -> str:
    if size < KIB:
        return f"{size} B"
    return f"{size // KIB} KiB" if size < MIB else f"{size // MIB} MiB"
