"""What the scene for headsets costs and how late it is, printed as figures.

Chromium draws by the processor here, on the cores that run all else: 32 by 32 pixels, of what is drawn one triangle
each, in a process that stands back for all others, so that what a headset has graphics hardware for takes next to
nothing. All else is as it is there: main thread and workers, the decoding and uploading of pictures of full size,
sockets, gateway, robot and ROS. What such hardware would add is not in the figures.

Nobody watches the browser meanwhile. Playwright would have each message of a WebSocket told to it as JSON: beside raw
pictures that took half a core and doubled what was measured. So this Chromium is asked by DevTools alone, and is
asked nothing while it is measured (`tests.support.devtools`). Nor are messages taken in the process of the test: a
node of its own does that.

On a shared machine no time decides a test, but what is measured has to have come."""

from __future__ import annotations

import asyncio
import base64
import itertools
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import Shared, Site, StartSite
from tests.page.headsets import PATIENT_ROBOT, UNDRAWN, Headset, needs_headset, scripts
from tests.page.polls import until
from tests.support.browser import needs_browser
from tests.support.devtools import LonePage, lone_page
from tests.support.processes import Process

pytestmark = [needs_browser, needs_headset, pytest.mark.alone, pytest.mark.soak, pytest.mark.timeout(280)]

MEASURED_S = 8.0
TRACED_S = 5.0
SETTLED_S = 3.0
"""What is done for the first time takes longer: programs for the graphics are made, and JavaScript is compiled."""
NAMES = ("bridge.cli.demo_robot", "tests.page.camera", "tests.page.lateness", "gateway", "agent", "router")
"""Words by which programs of the site are told apart."""
DRIVEN, HEAD = "/test/drive", "/xr/head"
HOLD_ON = """(() => {
  const grip = (value) => device.controllers.right.updateButtonValue('squeeze', value);
  window.holding = setInterval(() => {
    if (macsXr.telling.state.held) return;
    grip(0);
    setTimeout(() => grip(1), 60);
  }, 300);
})()"""
"""Hold the grip, anew where a busy machine let the scene stand still."""
LET_GO = "(() => { clearInterval(holding); device.controllers.right.updateButtonValue('squeeze', 0) })()"
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


class Late(Process):
    """How late messages with a stamp are that a ROS node gets, and that its middleware has before it."""

    def __init__(self, site: Site) -> None:
        topics = (f"{DRIVEN}=TwistStamped", f"{HEAD}=PoseStamped")
        super().__init__(sys.executable, "-m", "tests.page.lateness", *topics, env=ros(site))
        self.ms: dict[str, list[tuple[float, float]]] = {DRIVEN: [], HEAD: []}

    def _heard(self, line: str, *, is_log: bool) -> bool:
        topic, *ages = line.split(" ")
        if topic not in self.ms:
            return super()._heard(line, is_log=is_log)
        node_ms, middleware_ms = map(float, ages)
        self.ms[topic].append((node_ms, middleware_ms))
        return False


async def pictures(headset: Headset, folder: Path) -> None:
    """Some JPEG files of 640 by 480, made by the browser."""
    for shade in range(4):
        (folder / f"{shade}.jpg").write_bytes(base64.b64decode(await headset.value(JPEG, [40 * shade])))


async def measured(late: Late, topic: str, what: str) -> list[str]:
    """Of a topic what comes for a while, in words."""
    ages = late.ms[topic]
    await until(lambda: len(ages) > 20)
    await asyncio.sleep(SETTLED_S)
    ages.clear()
    load = Load()
    await asyncio.sleep(MEASURED_S)
    await until(lambda: len(ages) > 20)  # a busy machine lets go of what is held
    taken = list(ages)
    node, middleware = zip(*taken, strict=True)
    return [told(f"{what} to a ROS node", node), told("  to its middleware", middleware), load.told()]


class Load:
    """What programs took of the processor since it was made."""

    def __init__(self) -> None:
        self._before = self._taken()
        self._began = time.monotonic()

    def told(self) -> str:
        """In words, those that took most first."""
        took_s = time.monotonic() - self._began
        all_s = {name: s - self._before.get(name, 0.0) for name, s in self._taken().items()}
        most = sorted(all_s.items(), key=lambda each: -each[1])[:9]
        shares = ", ".join(f"{name} {s / took_s:.2f}" for name, s in most)
        return f"  cores taken: {sum(all_s.values()) / took_s:.2f} ({shares})"

    @staticmethod
    def _taken() -> dict[str, float]:
        """Program → seconds."""
        found: dict[str, float] = {}
        for pid in of_mine():
            if not (fields := stat(Path(f"/proc/{pid}/stat"))):
                continue
            # Chromium's have theirs as one word
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").replace("\0", " ").split()
            if not words:
                continue  # it has just ended
            kind = next((word[7:] for word in words if word.startswith("--type=")), "")
            name = kind or next((each for each in NAMES if each in words), Path(words[0]).name)
            found[name] = found.get(name, 0.0) + (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return found


def camera(site: Site, folder: Path, hz: float, raw_hz: float) -> Process:
    words = ("-m", "tests.page.camera", str(folder), str(hz), str(raw_hz))
    return Process(sys.executable, *words, env=ros(site))


def ros(site: Site) -> dict[str, str]:
    """For a program of the site's ROS domain."""
    return {"ROS_DOMAIN_ID": str(site.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@pytest.mark.parametrize("router", [True, False], ids=["router_beside", "gateway_is_router"])
async def test_how_late_and_how_dear(start_site: StartSite, shared: Shared, tmp_path: Path, *, router: bool) -> None:
    """Commands and poses to a ROS node, alone and beside raw pictures that fill the other socket; pictures of two
    cameras from their stamp to the scene; the main thread's work per frame, as Chromium traces it."""
    await shared.stop()  # its robot publishes all the time
    site = await start_site(rules=PATIENT_ROBOT, router=router)
    lines = [f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {'router' if router else 'no router'} beside"]
    settings = {"head": HEAD, "poseHz": 90, "hz": 30, "driveTopic": DRIVEN, "cameras": []}
    async with Late(site) as late, lone_page(tmp_path / "browser", width=160, height=120) as page:
        headset = Headset(page)
        async with page.watched():
            await page.open(f"{site.url}xr", *scripts(settings, size=UNDRAWN, rate=""))
            await headset.ready(pictures=False)
            await pictures(headset, tmp_path)
            await headset.enter()
            await headset.stick("right", 0, -1)
        stand_back()
        await page.evaluate(HOLD_ON)
        lines += await measured(late, DRIVEN, "command, from a browser")
        await page.evaluate(LET_GO)
        lines += await measured(late, HEAD, "pose, from a browser")
        async with camera(site, tmp_path, 0, 30):
            await show(headset, ["/test/raw"])
            beside = await measured(late, HEAD, "pose beside raw pictures of 0.9 MB,")
            raw_hz = await page.evaluate("[...macsXr.links.rates.values()].find(each => each.key.includes('raw')).hz")
            lines += [*beside, f"  {raw_hz:.0f} of these pictures a second"]
        async with camera(site, tmp_path, 30, 0):
            await show(headset, ["/test/jpeg", "/test/jpeg2"])
            lines += await with_two_cameras(page)
        assert await page.evaluate("problems") == []
    print("\n".join(["", *lines]))


def of_mine() -> set[int]:
    """This process, and all that it has started."""
    mine = {os.getpid()}
    parents = {
        int(path.parent.name): int(fields[1]) for path in Path("/proc").glob("[0-9]*/stat") if (fields := stat(path))
    }
    while more := {pid for pid, parent in parents.items() if parent in mine} - mine:
        mine |= more
    return mine


def stand_back() -> None:
    """Let what draws run when nothing else wants to; Chromium begins it with more right than others."""
    drawing = [pid for pid in of_mine() if b"--type=gpu-process" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert drawing
    for thread in itertools.chain.from_iterable(Path(f"/proc/{pid}/task").iterdir() for pid in drawing):
        os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))


def stat(path: Path) -> list[str]:
    """What a process says of itself, from its state on; nothing when it is gone."""
    try:
        return path.read_text().rpartition(")")[2].split()
    except OSError:
        return []


async def show(headset: Headset, topics: list[str]) -> None:
    """Choose cameras, and wait for their pictures."""
    await headset.value("(topics) => macsXr.settings.set('cameras', topics)", topics)
    enough = f"[...macsXr.room.screens.values()].filter((each) => each.shown > 5).length === {len(topics)}"
    await until(lambda: headset.value(enough))


async def with_two_cameras(page: LonePage) -> list[str]:
    await page.evaluate("(() => { macsXr.links.pictureMs.length = macsXr.frameMs.length = 0 })()")
    offset = float(await page.evaluate(CLOCK))
    load = Load()
    trace = await page.devtools.trace(["toplevel", "devtools.timeline"], TRACED_S)
    taken = load.told()
    ages = await page.evaluate("macsXr.links.pictureMs")
    frames = await page.evaluate("macsXr.frameMs")
    wall, cpu = work_per_frame(trace)
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
        taken,
    ]


def work_per_frame(events: list[dict[str, Any]]) -> tuple[list[float], list[float]]:
    """Of each frame the sum of the main thread's tasks, by the clock and by its processor, in ms."""
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
