"""What a robot agent costs against plain rclpy, in one run: ``python -m benchmarks.robot_speed [--quick] [--json]``.

Plain: a publisher and a raw subscription in two processes. Ours: the same publisher → robot agent → router → gateway
→ TCP headset, and back; each a process of its own. Both run in turn, medians of all rounds.

Exit code 0: measured; 1: something did not work.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from .processes import Program, ProgramFailed, Stage

KIB = 1 << 10
IMAGE = 900_000
QUIET_S = 2.0
RATES = (500, 1000, 1500, 2000, 2500, 3000, 3500, 4000, 5000, 6000)
IDLE_S = 10.0


class Site:
    """Everything that runs, and the topics in it: ``/plain`` has no robot agent, ``/robot`` and ``/command`` do."""

    def __init__(self, stage: Stage) -> None:
        os.environ.setdefault("ROS_DOMAIN_ID", str(50 + os.getpid() % 50))
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        router = stage.router()
        gateway = stage.gateway(router)
        arguments = ("-m", "bridge", "agent", "--id", "1", "-e", f"tcp/127.0.0.1:{router}")
        self.agent = stage._start("agent", *arguments)
        self.agent.line()
        self.publisher, _ = stage.worker("robot_ends", "ros")
        self.subscriber, _ = stage.worker("robot_ends", "ros")
        self.headset, _ = stage.worker("robot_ends", "headset", gateway, 1)
        self.five, _ = stage.worker("robot_ends", "headset", gateway, 5)
        self.depth = 1000  # a machine that others use stalls for tens of ms: that is not what is measured
        self.subscriber.ask("subscribe", topic="/plain", depth=self.depth)
        self.publisher.ask("advertise", topic="/plain", depth=self.depth, matched=1)
        time.sleep(1.0)
        self.headset.ask("register", topic="/robot", kind=1, buffer=self.depth)
        self.publisher.ask("advertise", topic="/robot", depth=self.depth, matched=1)
        self.five.ask("register", topic="/five", kind=1, buffer=self.depth)
        self.publisher.ask("advertise", topic="/five", depth=self.depth, matched=1)
        self.subscriber.ask("subscribe", topic="/command", depth=self.depth)
        time.sleep(0.5)
        self.headset.ask("register", topic="/command", kind=2, buffer=self.depth)
        time.sleep(1.5)

    def run(self, path: str, size: int, hz: float, seconds: float) -> dict[str, Any]:
        """Send on a path at a rate: how many were sent and arrived, and the latencies there."""
        sender, receiver, topic = self._ends(path)
        count = max(10, int(hz * seconds))
        receiver.tell("collect", count=count, quiet_s=QUIET_S + size / 1e6)
        took = sender.ask("publish", topic=topic, size=size, hz=hz, count=count)
        answer = receiver.answer()
        return {**answer, "sent": count, "lost": count - answer["got"], "hz": count / max(took["took_s"], 1e-9)}

    def _ends(self, path: str) -> tuple[Program, Program, str]:
        return {
            "plain": (self.publisher, self.subscriber, "/plain"),
            "to headset": (self.publisher, self.headset, "/robot"),
            "to five": (self.publisher, self.five, "/five"),
            "to topic": (self.headset, self.subscriber, "/command"),
        }[path]


def in_turn(site: Site, paths: list[str], rounds: int, size: int, hz: float, seconds: float) -> dict[str, Any]:
    """Each path once, then each once more …: medians, and what was lost in all."""
    runs: dict[str, list[dict[str, Any]]] = {path: [] for path in paths}
    for _ in range(rounds):
        for path in paths:
            runs[path].append(site.run(path, size, hz, seconds))
    return {
        path: {
            "p50_ms": median(run["p50_ms"] for run in of_path),
            "p99_ms": median(run["p99_ms"] for run in of_path),
            "lost": sum(run["lost"] for run in of_path),
            "sent": sum(run["sent"] for run in of_path),
        }
        for path, of_path in runs.items()
    }


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

    def used_s() -> float:
        with open(f"/proc/{agent.pid}/stat", encoding="ascii") as stat:  # noqa: PTH123
            fields = stat.read().rpartition(") ")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before = used_s()
    time.sleep(IDLE_S)
    with open(f"/proc/{agent.pid}/statm", encoding="ascii") as statm:  # noqa: PTH123
        pages = int(statm.read().split()[1])
    return {"cpu_percent": 100 * (used_s() - before) / IDLE_S, "mb": pages * os.sysconf("SC_PAGE_SIZE") / 1e6}


def measure(site: Site, args: argparse.Namespace) -> dict[str, Any]:
    """Every case."""
    rounds, seconds = (2, 3.0) if args.quick else (3, 20.0)
    cases: dict[str, Callable[[], Any]] = {
        "idle": lambda: idle(site.agent),
        "1 KiB, 100 Hz": lambda: in_turn(site, ["plain", "to headset", "to topic", "to five"], rounds, KIB, 100, 3),
        "rate at 1 KiB": lambda: {path: highest_rate(site, path, 2.0) for path in ("plain", "to headset", "to topic")},
        "64 KiB, 200 Hz": lambda: in_turn(site, ["plain", "to headset", "to topic"], 1, 64 * KIB, 200, seconds),
        "0.9 MB, 30 Hz": lambda: in_turn(site, ["plain", "to headset", "to topic"], 1, IMAGE, 30, seconds),
    }
    chosen = args.cases or list(cases)
    report = {}
    for name in chosen:
        report[name] = cases[name]()
        print(f"{name}: {json.dumps(report[name])}", file=sys.stderr)
    return report


def table(report: dict[str, Any]) -> str:
    """Lines of figure, ours, plain, target."""
    lines = [f"{'figure':<34}{'ours':>10}{'plain':>10}  target"]

    def line(name: str, ours: float, plain: float, target: str, met: bool) -> None:
        lines.append(f"{name:<34}{ours:>10.2f}{plain:>10.2f}  {target:<28}{'ok' if met else 'MISSED'}")

    for name, case in report.items():
        if name == "idle":
            line("idle, % of a core", case["cpu_percent"], 0, "< 2", case["cpu_percent"] < 2)
            line("idle, MB", case["mb"], 0, "<= 90", case["mb"] <= 90)
            continue
        for path in [path for path in case if path != "plain"]:
            if name.startswith("rate"):
                ours, plain = case[path], case["plain"]
                line(f"{name} {path}, msg/s", ours, plain, ">= 90 % of plain", ours >= 0.9 * plain)
                continue
            ours, plain = case[path]["p50_ms"], case["plain"]["p50_ms"]
            limit = plain + 0.6 if name.startswith("1 KiB") else 1.2 * plain + 1
            line(f"{name} {path}, p50 ms", ours, plain, f"<= {limit:.2f}", ours <= limit)
            lost = case[path]["lost"]
            line(f"{name} {path}, lost", lost, case["plain"]["lost"], f"0 of {case[path]['sent']}", lost == 0)
    return "\n".join(lines)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robot_speed", description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", help="1 KiB, 100 Hz; rate at 1 KiB; ... (default: all)")
    parser.add_argument("--quick", action="store_true", help="3 s instead of 20")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    load = os.getloadavg()[0]
    with Stage() as stage:
        try:
            report = measure(Site(stage), args)
        except ProgramFailed as error:
            print(error, file=sys.stderr)
            return 1
    report_text = json.dumps(report, indent=1) if args.json else table(report)
    print(report_text)
    print(f"{os.cpu_count()} CPUs, load {load:.2f} before, {os.getloadavg()[0]:.2f} after", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
