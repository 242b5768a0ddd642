"""Other programs beside ours, in one run: what a message of 1 KiB takes between a ROS topic and a client of each.

The user starts them, with the ROS_DOMAIN_ID that this run has too, and says where they listen:
``python -m benchmarks peers --peer ros-tcp=127.0.0.1:10000 --peer rosbridge=127.0.0.1:9090``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from .figures import Figure
from .plan import KIB, Case, Plan, Run, in_turn
from .processes import Program, Stage
from .robot_speed import QUIET_S, Site

HZ, SECONDS = 100.0, 5.0
ROOM_MS = 0.25
"""So many ms more than the quickest of them ours may take."""


class Client:
    """A client of one of them: ``to_client`` and ``to_topic`` are its topics."""

    def __init__(self, stage: Stage, site: Site, name: str, address: str) -> None:
        host, _, port = address.rpartition(":")
        self.to_client, self.to_topic = (f"/{name.replace('-', '_')}_{way}" for way in ("out", "in"))
        self.program: Program = stage.worker("peer_ends", name, host, port)[0]
        self.program.ask("advertise", topic=self.to_topic)
        site.subscriber.ask("subscribe", topic=self.to_topic, depth=site.depth)
        self.program.ask("subscribe", topic=self.to_client)
        site.publisher.ask("advertise", topic=self.to_client, depth=site.depth, matched=1)


def peers(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """1 KiB at 100 Hz between ROS and a client: ours, plain rclpy, and each --peer NAME=HOST:PORT."""
    site = Site(stage)
    clients = {name: Client(stage, site, name, address) for name, address in plan.peers.items()}
    time.sleep(1.0)
    ways = {
        "to client": {"rclpy": (site.publisher, site.subscriber, "/plain"), "ours": site.ends("to headset")},
        "to topic": {"rclpy": (site.publisher, site.subscriber, "/plain"), "ours": site.ends("to topic")},
    }
    for name, client in clients.items():
        ways["to client"][name] = (site.publisher, client.program, client.to_client)
        ways["to topic"][name] = (client.program, site.subscriber, client.to_topic)
    for way, ends in ways.items():
        values = in_turn(plan.rounds, {name: _run(plan, name, way, *each) for name, each in ends.items()})
        others = {name: each for name, each in values.items() if name != "ours"}
        for name, each in others.items():
            room = [value + ROOM_MS for value in each]
            most = 1.0 if name not in ("rclpy", "rosbridge") else None
            yield Figure(f"{way}, 1 KiB, ours, p50", values["ours"], room, f"{name} + {ROOM_MS}", "ms", at_most=most)
            if name != "rclpy":
                yield Figure(f"{way}, 1 KiB, {name}, p50", each, values["rclpy"], "rclpy", "ms")


def _run(plan: Plan, name: str, way: str, sender: Program, receiver: Program, topic: str) -> Run:
    count = max(20, int(HZ * SECONDS * plan.scale))

    def run() -> float:
        receiver.tell("collect", count=count, quiet_s=QUIET_S)
        sender.ask("publish", topic=topic, size=KIB, hz=HZ, count=count)
        answer = receiver.answer()
        if name in ("rclpy", "ours"):
            plan.arrived(f"peers, {name}, {way}", count, answer["got"])
        elif answer["got"] != count:
            plan.lost_where.append(f"peers, {name}, {way}: {count - answer['got']} of {count}, which is theirs")
        return float(answer["p50_ms"])

    return run


CASES: dict[str, Case] = {"peers": peers}
"""What needs rclpy, and programs that the user has started."""
