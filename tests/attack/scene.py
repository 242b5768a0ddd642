"""Two sites as processes, and the well-behaved people of the first: what an attack must not cost anybody.

Everybody here runs in the process of the test: 200 messages and 50 commands per second cost it little. Attackers have
a process of their own. Times are of the monotonic clock, which all processes of a machine share.
"""

from __future__ import annotations

import asyncio
import math
import os
import struct
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # before rclpy starts: nothing leaves this machine
os.environ.pop("ROS_STATIC_PEERS", None)

from geometry_msgs.msg import Twist
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool

from bridge.cli import robots
from bridge.cli.robots import Operator
from bridge.headset.client import Headset
from bridge.headset.nodes import Publisher
from bridge.ros.session import RosSession
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.messages import OPERATOR
from macs_zenoh.protocol.robot_state import RobotStatus
from tests.attack.judge import Memory, Report, Window
from tests.attack.site import (
    DEADMAN_S,
    MEMORY_LIMITS,
    MIB,
    ROBOT,
    SETTINGS,
    SLACK_BYTES,
    Site,
    forget_peak,
    status_bytes,
)
from tests.attack.table import Attack
from tests.attack.ways import Way
from tests.support.programs import ROOT

TALK_EVERY_S = 0.01
DRIVE_EVERY_S = 0.02
NO_EFFECT_S = 4.0
"""A stop or a dead-man that has done nothing by then counts as none."""
FAULT_LINES = 40
"""So many lines of a program's log are shown from its first fault on."""
STOPS_TO_A_LETTING_GO = 5
HOLDS_S = 0.15
"""How long after each stop the driver is watched driving in vain."""
RECOVERY_S = 60.0
"""By when everything must be as before. What a headset sent before it left is in the network still, up to 4 MB in its
own kernel, and is worked off at the pace that a gateway allows: so long it is online."""
BEGIN_S = 60.0
"""By when an attacker has made its frames and begins."""


# -- people ----------------------------------------------------------------------------------------------------------


class Pair:
    """Two headsets that talk to each other 100 times per second."""

    def __init__(self, left: Headset, right: Headset) -> None:
        self.headsets = (left, right)
        self.ids = (left.id, right.id)
        self._sent: dict[tuple[int, int], float] = {}
        """When each message was due; it is removed when it comes."""
        self._took: list[tuple[float, float]] = []
        self._tasks = [asyncio.create_task(job) for job in self._jobs(left, right)]

    def _jobs(self, left: Headset, right: Headset) -> Any:
        return self._say(left, right), self._say(right, left), self._hear(left, right), self._hear(right, left)

    async def _say(self, me: Headset, other: Headset) -> None:
        due, number = time.monotonic(), 0
        with suppress(MacsError):
            while True:
                self._sent[me.id, number] = due
                await me.send(
                    struct.pack("<d", due) + number.to_bytes(8, "little"), to=2, ids=[other.id], manager="Hi"
                )
                number += 1
                due += TALK_EVERY_S
                await asyncio.sleep(due - time.monotonic())

    async def _hear(self, me: Headset, other: Headset) -> None:
        with suppress(MacsError):
            while True:
                message = await me.receive()
                if message.metadata.message_manager == "Hi" and message.sender_id == other.id:
                    (due,) = struct.unpack_from("<d", message.data)
                    self._sent.pop((other.id, int.from_bytes(message.data[8:16], "little")), None)
                    self._took.append((due, time.monotonic() - due))

    def since(self, begin: float, end: float) -> list[float]:
        """Latencies of what was due in this time; what has not come by now counts as never."""
        came = [took for due, took in self._took if begin <= due < end]
        return came + [math.inf for due in self._sent.values() if begin <= due < end]

    def missing(self, begin: float, end: float) -> int:
        """How many of what was due then have not come."""
        return sum(begin <= due < end for due in self._sent.values())

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()


class Heard(NamedTuple):
    """What the robot's wheels were told."""

    at: float
    """When the robot agent published it: this process may be late to hear it, since it is everybody in the scene."""
    sent: float
    stop: bool
    """Whether it is the dead-man's message."""


class Wheels:
    """A ROS node on the robot: its motor, and a lamp that shows the emergency stop."""

    def __init__(self, domain: int) -> None:
        self.heard: list[Heard] = []
        self.lamp: list[tuple[float, bool]] = []
        """When the robot agent published what it shows."""
        self._epoch = time.time() - time.monotonic()
        self._session = RosSession("wheels", domain_id=domain)

    async def start(self) -> None:
        """Listen."""
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

        def make() -> None:
            node = self._session.node
            node.create_subscription(Twist, "/cmd_vel", self._drive, 100)
            node.create_subscription(Bool, "/emergency_stop", self._show, latched)

        await self._session.run(make)

    def _drive(self, twist: Any, about: dict[str, int]) -> None:
        self.heard.append(Heard(self._published(about), twist.linear.y, twist.linear.z == -1))

    def _show(self, state: Any, about: dict[str, int]) -> None:
        self.lamp.append((self._published(about), state.data))

    def _published(self, about: dict[str, int]) -> float:
        return about["source_timestamp"] / 1e9 - self._epoch

    @property
    def stopped(self) -> bool:
        """What the lamp shows."""
        return bool(self.lamp) and self.lamp[-1][1]

    @property
    def moving(self) -> bool:
        """Whether the last message was a command."""
        return bool(self.heard) and not self.heard[-1].stop

    def close(self) -> None:
        self._session.close()


class Driver:
    """A headset that drives the robot 50 times per second."""

    def __init__(self, headset: Headset, commands: Publisher) -> None:
        self.headset = headset
        self._commands = commands
        self.sent: list[float] = []
        """When each command was due."""
        self.last_at = -math.inf
        """When the last one was sent: the loop of this process may have been late."""
        self.drives = True
        self._task = asyncio.create_task(self._drive())

    async def _drive(self) -> None:
        due = time.monotonic()
        with suppress(MacsError):
            while True:
                if self.drives:
                    twist = Twist()
                    twist.linear.x, twist.linear.y = 0.5, due
                    self.sent.append(due)
                    self.last_at = time.monotonic()
                    await self._commands.publish(bytes(serialize_message(twist)))
                due += DRIVE_EVERY_S
                await asyncio.sleep(due - time.monotonic())

    def close(self) -> None:
        self._task.cancel()


# -- the scene -------------------------------------------------------------------------------------------------------


class Scene:
    """Everything, and what is measured in it. Made by `scene`."""

    def __init__(self, site: Site, other: Site, wheels: Wheels) -> None:
        self.site = site
        self.other = other
        self.wheels = wheels
        self.pair: Pair
        self.driver: Driver
        self.presser: Headset
        self.operator: Operator
        self._button: Publisher
        self._turn = 0

    @property
    def good(self) -> list[Headset]:
        """The headsets that behave."""
        return [*self.pair.headsets, self.driver.headset, self.presser]

    async def settle(self, stack: AsyncExitStack) -> None:
        """Let the people come, and wait until the robot drives."""
        headsets = [await stack.enter_async_context(await self.newcomer()) for _ in range(4)]
        left, right, driver, self.presser = headsets
        while ROBOT not in (await driver.online()).ros_agent_ids:
            await asyncio.sleep(0.02)
        asking = robots.operator(self.site.mesh, AgentId(OPERATOR, 7), timeout_s=10)
        self.operator = await stack.enter_async_context(asking)
        self.pair = Pair(left, right)
        stack.callback(self.pair.close)
        self._button = await self.presser.advertise("/emergency_stop", "std_msgs/Bool", agents=[ROBOT])
        commands = await driver.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[ROBOT])
        self.driver = Driver(driver, commands)
        stack.callback(self.driver.close)
        await until(lambda: self.wheels.moving and bool(self.wheels.lamp), 20, "the robot to drive")

    async def newcomer(self) -> Headset:
        """A headset more."""
        return await Headset.connect("127.0.0.1", self.site.gateway.port)

    # -- one attack --

    async def suffer(self, attack: Attack, *, seconds: float, stops: int | None = None) -> Report:
        """Calm, the attack on the other site, then on this one. ``stops`` instead of as many as there is time for."""
        calm = await self.observe(min(seconds, 1.5))
        async with self._attacked(attack, self.other, seconds, stops):
            benign = await self.observe(seconds, min(stops or 0, 20) or None)
        before = await self._facts()
        memory = {name: Memory(status_bytes(p.pid, "VmRSS")) for name, p in self.site.programs.items()}
        for program in self.site.programs.values():
            forget_peak(program.pid)
        began = time.monotonic()
        async with self._attacked(attack, self.site, seconds, stops):
            under = await self.observe(seconds, stops)
        broken = await self._as_before(before, began)
        for name, program in self.site.programs.items():
            with suppress(OSError):
                memory[name].peak = status_bytes(program.pid, "VmHWM")
                memory[name].after = status_bytes(program.pid, "VmRSS")
        broken += [
            f"the {name} keeps {m.kept / MIB:.0f} MiB"
            for name, m in memory.items()
            if m.kept > SLACK_BYTES and name in MEMORY_LIMITS
        ]
        return Report(
            attack.name,
            attack.single,
            calm,
            benign,
            under,
            memory,
            MEMORY_LIMITS,
            commands_promised=attack.by not in ("mesh", "operator"),
            neighbours_promised=not attack.addressed,
            broken=broken,
        )

    @asynccontextmanager
    async def _attacked(self, attack: Attack, site: Site, seconds: float, stops: int | None) -> AsyncIterator[None]:
        """While the block runs this site is attacked."""
        length = seconds if stops is None else 3600.0
        words = (
            *(attack.name, str(site.attacked_port), site.endpoint, str(length)),
            *(str(site.pki or ""), site.attacked_by),
        )
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.attack.attacker", *words), cwd=ROOT, stdout=asyncio.subprocess.PIPE
        )
        try:
            assert process.stdout is not None
            line = await asyncio.wait_for(process.stdout.readline(), BEGIN_S)
            assert line == b"begins\n", f"{attack.name} did not begin: {line!r}"
            yield
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()

    # -- measuring --

    async def observe(self, seconds: float, stops: int | None = None) -> Window:
        """Talk, drive, stop and let go for so long, or until so many stops were pressed."""
        window = Window()
        begin = time.monotonic()
        while time.monotonic() - begin < seconds if stops is None else len(window.stops) < stops:
            if not await self._stop_once(window):
                break
            if stops is not None and len(window.stops) % STOPS_TO_A_LETTING_GO:
                continue  # it is the stops that are to be many
            if not await self._let_go_once(window):
                break
        end = time.monotonic()
        await until(lambda: not self.pair.missing(begin, end), NO_EFFECT_S, quietly=True)
        window.latencies = self.pair.since(begin, end)
        window.commands = self._commands(begin, end)
        return window

    def _commands(self, begin: float, end: float) -> list[float]:
        came = {h.sent: h.at for h in self.wheels.heard if not h.stop and begin <= h.sent < end}
        return [came[sent] - sent if sent in came else math.inf for sent in self.driver.sent if begin <= sent < end]

    async def _stop_once(self, window: Window) -> bool:
        """Press once, alternately a headset's button and an operator's, and measure until nothing moves any more. Also
        where the driver cannot get the robot to move: then until it is known that it is stopped."""
        await self._moves(window)
        self._turn += 1
        by_headset = bool(self._turn % 2)
        pressed = time.monotonic()
        asking = None if by_headset else asyncio.create_task(self._ask_stop(b"true"))
        if by_headset:
            with suppress(MacsError):
                await self._button.publish(STATES[True])
        await until(lambda: self.wheels.stopped, NO_EFFECT_S, quietly=True)
        if asking is not None:
            asking.cancel()
        if not self.wheels.stopped:
            window.stops.append(math.inf)
            return await self._release(by_headset=by_headset)
        shown = self.wheels.lamp[-1][0]
        await asyncio.sleep(HOLDS_S)
        window.stops.append(shown - pressed)
        window.late_commands += sum(heard.at > shown and not heard.stop for heard in self.wheels.heard)
        return await self._release(by_headset=by_headset)

    async def _ask_stop(self, data: bytes) -> None:
        with suppress(MacsError):
            await self.operator.ask(ROBOT, "stop", data, timeout_s=NO_EFFECT_S, urgent=True)

    async def _release(self, *, by_headset: bool) -> bool:
        """Let the robot go on, by who has stopped it, however often that has to be said; a release may get lost where
        commands may, and then the operator releases it."""
        began = time.monotonic()
        while (passed := time.monotonic() - began) < 2 * NO_EFFECT_S:
            with suppress(MacsError, asyncio.TimeoutError):
                if by_headset and passed < NO_EFFECT_S:
                    await self._button.publish(STATES[False])
                else:
                    await asyncio.wait_for(self._ask_stop(b"false"), 0.5)
            if await until(lambda: not self.wheels.stopped, 0.3, quietly=True):
                return True
        return False

    async def _moves(self, window: Window) -> bool:
        """Whether the driver drives."""
        self.driver.drives = True
        moves = await until(lambda: self.wheels.moving, NO_EFFECT_S, quietly=True)
        window.at_rest += not moves
        return moves

    async def _let_go_once(self, window: Window) -> bool:
        """The driver stops commanding without a word; when the dead-man does its work. Of a robot at rest nothing is
        learned. Whether to go on."""
        if not await self._moves(window):
            return True
        begin = time.monotonic()
        await asyncio.sleep(0.15)
        window.trips += sum(heard.stop and heard.at > begin for heard in self.wheels.heard)
        if not await self._moves(window):
            return True
        self.driver.drives = False
        last = self.driver.last_at
        stopped = await until(lambda: self._stopped_since(last), NO_EFFECT_S, quietly=True)
        self.driver.drives = True
        at = next((h.at for h in self.wheels.heard if h.stop and h.at > last), math.inf)
        window.deadman.append(max(0.0, at - last - DEADMAN_S))
        return stopped

    def _stopped_since(self, moment: float) -> bool:
        return bool(self.wheels.heard) and self.wheels.heard[-1].stop and self.wheels.heard[-1].at > moment

    # -- as before --

    async def _facts(self) -> dict[str, Any]:
        """What must be the same afterwards."""
        online = await self.presser.online(timeout_s=10)
        _, status = robots.read(await self.operator.ask(ROBOT, "status", timeout_s=10), RobotStatus)
        return {
            "who is online": (online.ros_agent_ids, online.unity_agent_ids),
            "interface nodes": sorted((node.role, node.name, tuple(node.registrants)) for node in status.nodes),
        }

    async def _as_before(self, before: dict[str, Any], began: float) -> list[str]:
        """What is not as it was before the attack, in words."""
        for name, program in self.site.programs.items():
            if not Path(f"/proc/{program.pid}/task").exists() or _is_zombie(program.pid):
                return [f"the {name} has ended"]
        broken = [f"headset {h.id} was cut: {h.why_ended}" for h in self.good if not h.connected]
        if broken:
            return broken
        now: dict[str, Any] = {}

        async def same() -> bool:
            with suppress(MacsError):
                now.update(await self._facts())
            return now == before

        deadline = time.monotonic() + RECOVERY_S
        while not await same() and time.monotonic() < deadline:
            await asyncio.sleep(0.1)
        broken += [
            f"{what}: {str(before[what])[:200]} before, {str(now.get(what))[:200]} after"
            for what in before
            if now.get(what) != before[what]
        ]
        self.driver.drives = True
        if not await until(
            lambda: self.wheels.moving and self.wheels.heard[-1].at > time.monotonic() - 0.2, 5, quietly=True
        ):
            broken.append("the driver's commands do not arrive any more")
        if self.wheels.stopped:
            broken.append("the robot is stopped")
        if missing := self.pair.missing(began, time.monotonic() - 1):
            broken.append(f"{missing} of the neighbours' messages were lost")
        broken += await self._newcomer_is_served()
        for name in ("gateway", "robot"):
            log = self.site.programs[name].log
            faults = [at for at, line in enumerate(log) if "Traceback" in line or " E macs" in line]
            if faults:
                broken.append(f"the {name} has a fault in its log: {log[faults[0]][:200]}")
                print(f"the {name}'s log:", *log[faults[0] : faults[0] + FAULT_LINES], sep="\n", file=sys.stderr)
                log.clear()
        return broken

    async def _newcomer_is_served(self) -> list[str]:
        """A headset that comes now gets an id, may register to drive, hears the robot, and reaches others."""
        try:
            async with await self.newcomer() as headset:
                await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[ROBOT])
                lamp = await headset.subscribe("/emergency_stop", "std_msgs/Bool", agents=[ROBOT])
                await asyncio.wait_for(lamp.__anext__(), 5)
                _, status = robots.read(await self.operator.ask(ROBOT, "status", timeout_s=5), RobotStatus)
                me = f"unity/{headset.id}"
                if not any(node.name == "/cmd_vel" and me in " ".join(node.registrants) for node in status.nodes):
                    return [f"a newcomer may not drive: {[node.registrants for node in status.nodes]}"]
        except (MacsError, asyncio.TimeoutError, OSError) as error:
            return [f"a newcomer is not served: {error!r}"]
        return []


STATES = {True: b"\x00\x01\x00\x00\x01", False: b"\x00\x01\x00\x00\x00"}


def _is_zombie(pid: int) -> bool:
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True


async def until(
    condition: Callable[[], object], timeout_s: float, what: str = "something", *, quietly: bool = False
) -> bool:
    """Wait for a condition, looking often; whether it came."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            assert quietly, f"waited {timeout_s:g} s in vain for {what}"
            return False
        await asyncio.sleep(0.002)
    return True


@asynccontextmanager
async def scene(directory: Path, domain: int, *, certified: bool = False, way: Way = "tcp") -> AsyncIterator[Scene]:
    """Everything started, the robot driving; ``certified``: on sites that let in nobody without a certificate. TCP
    agents that attack come in by this ``way``."""
    settings = directory / "macs.toml"
    settings.write_text(SETTINGS)
    pki = [Path(tempfile.mkdtemp(dir=directory)) / "pki" if certified else None for _ in range(2)]
    async with AsyncExitStack() as stack:
        site, other = Site(settings, domain, pki[0], way), Site(settings, domain % 100 + 1, pki[1], way)
        await asyncio.gather(site.start(stack), other.start(stack))
        wheels = Wheels(domain)
        stack.callback(wheels.close)
        await wheels.start()
        made = Scene(site, other, wheels)
        await made.settle(stack)
        yield made
