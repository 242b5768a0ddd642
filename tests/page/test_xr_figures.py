"""What the scene for headsets costs and how late it is, printed as figures.

Chromium draws by the processor here, on the cores that run all else: 32 by 32 pixels, of what is drawn one triangle
each, in a process that stands back for all others, so that what a headset has graphics hardware for takes next to
nothing. All else is as it is there: main thread and workers, the decoding and uploading of pictures of full size,
sockets, gateway, robot and ROS. What such hardware would add is not in the figures.

On a shared machine no time decides a test, but what is measured has to have come."""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped, TwistStamped

from tests.page.conftest import Site
from tests.page.headsets import PATIENT_ROBOT, UNDRAWN, Headset, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser
from tests.support.processes import Process
from tests.support.ros_peer import Peer

pytestmark = [needs_browser, needs_headset, pytest.mark.alone, pytest.mark.soak, pytest.mark.timeout(280)]
RULES = PATIENT_ROBOT
"""The robot is patient."""

MEASURED_S = 8.0
DRIVEN = "/test/drive"
CLOCK = "(() => { const now = performance.timeOrigin + performance.now(); return Date.now() - now })()"
JPEG = """async ([shade]) => {
  const canvas = new OffscreenCanvas(640, 480);
  const context = canvas.getContext('2d');
  for (let at = 0; at < 900; at++) {
    context.fillStyle = `hsl(${(at * 37 + shade) % 360} 60% ${30 + (at * 7) % 50}%)`;
    context.fillRect((at * 83) % 640, (at * 59) % 480, 40, 30);
  }
  const blob = await canvas.convertToBlob({ type: 'image/jpeg', quality: 0.8 });
  const bytes = new Uint8Array(await blob.arrayBuffer());
  let text = '';
  for (const byte of bytes) text += String.fromCharCode(byte);
  return btoa(text);
}"""


def part(values: Sequence[float], share: float) -> float:
    """The value below which this share of them is."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def told(name: str, values: Sequence[float], unit: str = "ms") -> str:
    return (
        f"{name}: p50 {statistics.median(values):.2f}, p95 {part(values, 0.95):.2f}, p99 {part(values, 0.99):.2f}, "
        f"most {max(values):.2f} {unit} of {len(values)}"
    )


class Late:
    """How late messages with a stamp are that a ROS node gets."""

    def __init__(self) -> None:
        self.ms: list[float] = []

    async def listen(self, peer: Peer, kind: type[Any], topic: str) -> None:
        def take(message: Any) -> None:
            stamp = message.header.stamp
            self.ms.append(time.time() * 1000 - (stamp.sec * 1000 + stamp.nanosec / 1e6))

        await peer.session.run(lambda: peer.session.node.create_subscription(kind, topic, take, 1000))


async def pictures(headset: Headset, folder: Path) -> None:
    """Some JPEG files of 640 by 480, made by the browser."""
    for shade in range(4):
        (folder / f"{shade}.jpg").write_bytes(base64.b64decode(await headset.value(JPEG, [40 * shade])))


async def measured(late: Late) -> list[float]:
    await until(lambda: len(late.ms) > 20)
    late.ms.clear()
    await asyncio.sleep(MEASURED_S)
    return list(late.ms)


def camera(site: Site, folder: Path, hz: float, raw_hz: float) -> Process:
    environment = {"ROS_DOMAIN_ID": str(site.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    words = ("-m", "tests.page.camera", str(folder), str(hz), str(raw_hz))
    return Process(sys.executable, *words, env=environment)


async def test_how_late_and_how_dear(site: Site, tmp_path: Path) -> None:
    """Commands and poses to a ROS node, alone and beside raw pictures that fill the other socket; pictures of two
    cameras from their stamp to the scene; the main thread's work per frame, as Chromium traces it."""
    peer, drives, poses = Peer(site.domain), Late(), Late()
    lines = [f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"]
    settings = {"head": "/xr/head", "poseHz": 90, "hz": 30, "driveTopic": DRIVEN, "cameras": []}
    try:
        await drives.listen(peer, TwistStamped, DRIVEN)
        await poses.listen(peer, PoseStamped, "/xr/head")
        headset = await headset_at(site, settings=settings, size=UNDRAWN, rate="")
        await headset.ready(pictures=False)
        await pictures(headset, tmp_path)
        await headset.enter()
        await headset.page.set_viewport_size({"width": 160, "height": 120})  # the page around it is not drawn in XR
        stand_back()
        offset = float(await headset.value(CLOCK))
        await headset.stick("right", 0, -1)
        holding = asyncio.create_task(hold_on(headset))
        commands = await measured(drives)
        holding.cancel()
        await asyncio.gather(holding, return_exceptions=True)
        lines.append(told("command, browser to ROS node", commands))
        await headset.squeeze("right", held=False)
        lines.append(told("pose, browser to ROS node", await measured(poses)))
        async with camera(site, tmp_path, 0, 30):
            await show(headset, ["/test/raw"])
            beside = await measured(poses)
            raw_hz = await headset.value("[...macsXr.links.rates.values()].find(each => each.key.includes('raw')).hz")
            lines.append(told(f"pose beside {raw_hz:.0f} raw pictures of 0.9 MB a second", beside))
        async with camera(site, tmp_path, 30, 0):
            await show(headset, ["/test/jpeg", "/test/jpeg2"])
            lines += await with_two_cameras(site, headset, offset, tmp_path)
    finally:
        peer.session.close()
    print("\n".join(["", *lines]))


def stand_back() -> None:
    """Let the process that draws run when nothing else wants to; Chromium begins it with more right than others."""
    mine = {os.getpid()}
    parents = {
        int(path.parent.name): int(fields[1]) for path in Path("/proc").glob("[0-9]*/stat") if (fields := stat(path))
    }
    while more := {pid for pid, parent in parents.items() if parent in mine} - mine:
        mine |= more
    drawing = [pid for pid in mine if b"--type=gpu-process" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert drawing
    for thread in Path(f"/proc/{drawing[0]}/task").iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))


def stat(path: Path) -> list[str]:
    """What a process says of itself, from its state on; nothing when it is gone."""
    try:
        return path.read_text().rpartition(")")[2].split()
    except OSError:
        return []


async def hold_on(headset: Headset) -> None:
    """Hold the grip, anew where a busy machine let the scene stand still."""
    while True:
        held = await headset.state("held")
        if not held:
            await headset.squeeze("right", held=False)
            await headset.frame()
            await headset.squeeze("right", held=True)
        await asyncio.sleep(0.3)


async def show(headset: Headset, topics: list[str]) -> None:
    """Choose cameras, and wait for their pictures."""
    await headset.value("(topics) => macsXr.settings.set('cameras', topics)", topics)
    enough = f"[...macsXr.room.screens.values()].filter((each) => each.shown > 5).length === {len(topics)}"
    await until(lambda: headset.value(enough))


async def with_two_cameras(site: Site, headset: Headset, offset: float, folder: Path) -> list[str]:
    await headset.value("macsXr.links.pictureMs.length = 0; macsXr.frameMs.length = 0")
    trace = folder / "trace.json"
    browser = await site.chromium()
    await browser.start_tracing(page=headset.page, path=trace, categories=["toplevel", "devtools.timeline"])
    await asyncio.sleep(4)
    await browser.stop_tracing()
    ages = json.loads(await headset.value("JSON.stringify(macsXr.links.pictureMs)"))
    frames = json.loads(await headset.value("JSON.stringify(macsXr.frameMs)"))
    wall, cpu = work_per_frame(json.loads(trace.read_text()))
    assert len(ages) > 20
    assert len(wall) > 20
    return [
        told(
            "picture, stamp to scene, two cameras of 640 x 480 JPEG at 30 Hz", [e["sinceStamp"] + offset for e in ages]
        ),
        told("picture, socket to scene", [each["sinceSocket"] for each in ages]),
        told("main thread per frame, traced, on the clock", wall),
        told("main thread per frame, traced, of its processor", cpu),
        told("scene's own part of a frame, on the clock", frames),
    ]


def work_per_frame(trace: dict[str, Any]) -> tuple[list[float], list[float]]:
    """Of each frame the sum of the main thread's tasks, by the clock and by its processor, in ms."""
    events = trace["traceEvents"]
    names = {(each["pid"], each["tid"]): each["args"]["name"] for each in events if each.get("name") == "thread_name"}
    fired = [each for each in events if each.get("name") == "FireAnimationFrame"]
    assert fired, "no frame was traced"
    main = max({(e["pid"], e["tid"]) for e in fired}, key=lambda key: sum((e["pid"], e["tid"]) == key for e in fired))
    assert names.get(main) == "CrRendererMain"
    of_main = [each for each in events if (each.get("pid"), each.get("tid")) == main]
    begins = sorted({each["ts"] for each in of_main if each.get("name") == "FireAnimationFrame"})
    tasks = outermost([each for each in of_main if each.get("ph") == "X" and "dur" in each])
    wall, cpu, at = [], [], 0
    for begin, end in itertools.pairwise(begins):
        mine = []
        while at < len(tasks) and tasks[at]["ts"] + tasks[at]["dur"] <= begin:
            at += 1
        each = at
        while each < len(tasks) and tasks[each]["ts"] < end:
            if tasks[each]["ts"] + tasks[each]["dur"] > begin and tasks[each]["ts"] + tasks[each]["dur"] <= end:
                mine.append(tasks[each])
            each += 1
        if mine:
            wall.append(sum(task["dur"] for task in mine) / 1000)
            cpu.append(sum(task.get("tdur", task["dur"]) for task in mine) / 1000)
    return wall, cpu


def outermost(tasks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those that are in no other one, in order."""
    found: list[dict[str, Any]] = []
    for task in sorted(tasks, key=lambda each: (each["ts"], -each["dur"])):
        if not found or task["ts"] >= found[-1]["ts"] + found[-1]["dur"]:
            found.append(task)
    return found
