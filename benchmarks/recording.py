"""A headset's latency beside a recording of everything, against the same without one.

What a recording takes is the router's and the processor's as well as its own: so the same run has plain Zenoh
subscribers in its place that hear the same. One does nothing with it, which no recording can cost less than, and one
writes the bytes to a file.

All robots publish all the time. Without a recording the data of one goes through the router, as nobody looks at the
others, and beside it that of all. ``recording_of_seen`` has headsets that look at the others all the time: what is
left between the two is the way from the router to the recorder, and the recorder.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from macs_zenoh.protocol.keyexpr import STREAM
from tests.support.processes import ROOT

from .figures import Figure
from .plan import Case, Plan
from .processes import Program, ProgramFailed, Stage
from .recorded_robot import TOPICS

ROBOTS = 3
IMAGE, IMAGE_HZ = 900_000, 30.0
SMALL, SMALL_HZ = 100, 2000.0
SECONDS = 15.0
BESIDE = 1.2
"""So many times as long a message may take beside a recording."""
QUIET_S = 2.0
READY_S = 20.0
ALONE, RECORDED, DROPPED, SAVED = "without", "macs record", "a subscriber that does nothing", "a plain subscriber"


class Site:
    """Robots, of which a headset looks at the first, and whoever listens besides."""

    def __init__(self, stage: Stage, folder: Path, *, seen: bool = False) -> None:
        self._folder = folder
        self._seen = seen
        self._port = stage.router()
        gateway = stage.gateway(self._port)
        self.robots = [stage.worker("recorded_robot", self._port, number)[0] for number in range(1, ROBOTS + 1)]
        self.small, _ = stage.worker("robot_ends", "headset", gateway, 1)
        self.large, _ = stage.worker("robot_ends", "headset", gateway, 1)
        self.plain, _ = stage.worker("raw", "zenoh", self._port)
        others = range(2, ROBOTS + 1) if seen else ()
        self._viewers = [stage.worker("robot_ends", "headset", gateway, 1)[0] for _ in others]
        time.sleep(1.0)
        for robot, viewer in zip(others, self._viewers, strict=True):
            viewer.ask("register", topic="/image", kind=1, buffer=10, robot=robot)
            viewer.ask("register", topic="/small", kind=1, buffer=1000, robot=robot)
        self.large.ask("register", topic="/image", kind=1, buffer=10)
        self.small.ask("register", topic="/small", kind=1, buffer=1000)
        self._until(self.robots if seen else self.robots[:1], 1)
        for robot in self.robots:
            robot.ask("keep")
        self.used: Counter[str] = Counter()

    def beside(self, what: str, seconds: float, plan: Plan) -> dict[str, float]:
        """The headset's p99 for both topics, in ms, while somebody else listens or nobody does."""
        path = self._folder / "recorded"
        listener = self._listen(what, path)
        began = self._used_by(what, listener)
        try:
            found = self._measure(seconds, plan)
            if isinstance(listener, subprocess.Popen):
                time.sleep(0.5)
        finally:
            self.used[what] += self._used_by(what, listener) - began
            if isinstance(listener, subprocess.Popen):
                listener.send_signal(signal.SIGINT)
                said = listener.communicate(timeout=30)[0].decode()
                print(f"  {said.splitlines()[-1]}", file=sys.stderr)
            elif listener is not None:
                listener.ask("saved" if what == SAVED else "dropped")
        if what == RECORDED:
            self._check(path.with_suffix(".mcap"), seconds, plan)
        for file in self._folder.iterdir():
            file.unlink()
        for robot in self.robots:
            robot.ask("forget")
        return found

    def _listen(self, what: str, path: Path) -> subprocess.Popen[bytes] | Program | None:
        if what == ALONE:
            return None
        if what in (SAVED, DROPPED):
            where = {"path": str(path)} if what == SAVED else {}
            self.plain.ask("save" if where else "drop", key=STREAM.every(type=1), **where)
            time.sleep(0.3)
            return self.plain
        endpoint, file = f"tcp/127.0.0.1:{self._port}", str(path.with_suffix(".mcap"))
        arguments = [sys.executable, "-m", "bridge", "record", "-e", endpoint, "-o", file]
        process = subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE)
        self._until(self.robots[:1], 2)
        self._until(self.robots[1:], 2 if self._seen else 1)
        time.sleep(0.5)
        return process

    @staticmethod
    def _used_by(what: str, listener: subprocess.Popen[bytes] | Program | None) -> float:
        if listener is None:
            return 0.0
        fields = Path(f"/proc/{listener.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / 100

    def _measure(self, seconds: float, plan: Plan) -> dict[str, float]:
        counts = {"/image": int(IMAGE_HZ * seconds), "/small": int(SMALL_HZ * seconds)}
        self.small.tell("collect", count=counts["/small"], quiet_s=QUIET_S)
        self.large.tell("collect", count=counts["/image"], quiet_s=QUIET_S)
        for viewer in self._viewers:
            viewer.tell("look", quiet_s=QUIET_S)
        for robot in self.robots:
            robot.ask("publish", topic="/image", size=IMAGE, hz=IMAGE_HZ, count=counts["/image"])
            robot.ask("publish", topic="/small", size=SMALL, hz=SMALL_HZ, count=counts["/small"])
        for robot in self.robots:
            robot.tell("published")
            robot.answer(seconds)
        small, large = self.small.answer(), self.large.answer()
        for viewer in self._viewers:
            viewer.answer()
        plan.delivered += small["got"] + large["got"]
        return {"small": small["p99_ms"], "small, p50": small["p50_ms"], "image": large["p99_ms"]}

    def _check(self, path: Path, seconds: float, plan: Plan) -> None:
        """Every message is in the file."""
        from bridge.recording.bag import Bag

        wanted = {"/image": int(IMAGE_HZ * seconds), "/small": int(SMALL_HZ * seconds)}
        with Bag(path) as bag:
            found = {channel.topic: bag.counts.get(channel.id, 0) for channel in bag.channels.values()}
        for robot in range(1, ROBOTS + 1):
            for topic, count in wanted.items():
                plan.arrived(f"recording of /{robot}{topic}", count, found.get(f"/{robot}{topic}", 0))

    @staticmethod
    def _until(robots: list[Program], registrants: int) -> None:
        deadline = time.monotonic() + READY_S
        while any(robot.ask("registrants")[topic] < registrants for robot in robots for topic in TOPICS):
            if time.monotonic() > deadline:
                raise ProgramFailed("nobody registered on the robots' topics")
            time.sleep(0.1)


def recording(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """A headset's p99 beside a recording of 3 robots with 0.9 MB at 30 Hz and 2 000 small messages a second each."""
    return _recording(stage, plan, seen=False)


def recording_of_seen(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """The same where headsets look at all three robots, with a recording and without."""
    return _recording(stage, plan, seen=True)


def _recording(stage: Stage, plan: Plan, *, seen: bool) -> Iterator[Figure]:
    seconds = SECONDS * plan.scale
    folder = Path(tempfile.mkdtemp(prefix="macs-recording-"))
    values: dict[str, list[dict[str, float]]] = {ALONE: [], RECORDED: [], DROPPED: [], SAVED: []}
    try:
        site = Site(stage, folder, seen=seen)
        for _ in range(plan.rounds):
            for what, found in values.items():
                found.append(site.beside(what, seconds, plan))
    finally:
        shutil.rmtree(folder, ignore_errors=True)

    def of(what: str, name: str) -> list[float]:
        return [each[name] for each in values[what]]

    measured: dict[str, Any] = {"small": "2 000/s", "small, p50": "2 000/s", "image": "0.9 MB"}
    where = "of robots that others see" if seen else ""
    for name, said in measured.items():
        kind = "p50" if "p50" in name else "p99"
        bound = BESIDE if kind == "p99" else None
        title = " ".join(f"headset's {kind}, {said}, {where} beside".split())
        yield Figure(f"{title} a recording", of(RECORDED, name), of(ALONE, name), ALONE, "ms", at_most=bound)
        for other in (DROPPED, SAVED):
            yield Figure(f"{title} {other}", of(other, name), of(ALONE, name), ALONE, "ms")
            yield Figure(f"{title} a recording", of(RECORDED, name), of(other, name), other, "ms")
    used = {what: site.used[what] / plan.rounds / seconds * 100 for what in (RECORDED, DROPPED, SAVED)}
    for other in (DROPPED, SAVED):
        yield Figure("a recording's processor", [used[RECORDED]], [used[other]], other, "% of a core")


CASES: dict[str, Case] = {"recording": recording, "recording_of_seen": recording_of_seen}
