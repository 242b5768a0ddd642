"""Start router, gateway and robot agent on this machine, in one command.

Each is a program of its own, started again when it ends; their logs come with their names in
front. Ctrl-C stops them all. Without rclpy the robot is left out.

--demo adds a robot without hardware (a camera image, a pose, /cmd_vel) and a headset that
shows what it receives and drives it. So that it never moves a real robot, the demo has a ROS
domain of its own on this machine only, chosen free whatever ROS_DOMAIN_ID says, and a namespace
of its own on the mesh. Both are printed, and so is the free port that it takes where the usual one is in use.

examples:
  macs up --demo
  macs up --host 0.0.0.0 --id 7             headsets and other robots from the network
  macs up -e tcp/192.168.1.10:7447          gateway and robot here, router there

what it prints:
  It runs. Ctrl-C stops it; meanwhile, in another terminal:
    who is online      macs ls
    receive a topic    macs headset 127.0.0.1:7000 sub /TOPIC pkg/Type
  A Unity headset connects to 127.0.0.1:7000, from this machine only.
  Watch and drive in a browser at http://127.0.0.1:7080 (programs: ws://127.0.0.1:7080/macs).
  In a headset's browser: http://127.0.0.1:7080/xr"""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import logging
import os
from contextlib import suppress
from dataclasses import dataclass

from bridge.cli import options, output, running, supervisor
from bridge.cli.apart import Apart
from bridge.cli.supervisor import Child, stop_in_order
from bridge.listening import bound, for_others
from bridge.logs import prefix_logs
from bridge.settings import GatewaySettings, RobotSettings, Settings
from macs_zenoh.errors import MacsError, Unreachable, UsageError
from macs_zenoh.protocol import endpoints
from macs_zenoh.protocol.addresses import EVERYWHERE, is_local, joined, reachable
from macs_zenoh.protocol.websocket import WEBSOCKET_PATH
from macs_zenoh.sections import changed
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.up")

SUMMARY = "all of it on this machine: router, gateway, robot"

DEFAULT_ROBOT = 1
ROUTER_PORT = 7447
WEB_PORT = 7080
WEB_HOST = "127.0.0.1"
"""Of the web port unless settings say otherwise: who comes there needs no token, and browsers call it secure."""
DEMO_BLOCK = 1
"""Of ids for those who connect over TCP: none of them gets the demo robot's, should it be a robot, too."""
READY_S = 20.0
"""How long the programs may take to be ready for a show that nobody watches (``--once``); others press Ctrl-C."""
DRIVE = """'{"linear": {"x": 0.2}}' --rate 10"""


class PortTaken(Unreachable):
    """Somebody else listens there."""

    def __init__(self, host: str, port: int, advice: str) -> None:
        super().__init__(joined(host, port), f"the port is taken; {advice}")
        self.port = port


class NotReady(MacsError):
    """Programs still wait for something, most often for a router that is not there."""

    def __init__(self, names: list[str], routers: list[str]) -> None:
        super().__init__(
            f"not ready within {READY_S:g} s: {', '.join(names)}; is there a router at {', '.join(routers)}?"
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--demo", action="store_true", help="add a demo robot, and a headset that drives it")
    parser.add_argument("--once", action="store_true", help="with --demo: end after the show, 0 if all of it worked")
    parser.add_argument(
        "--host", help="where gateway and router listen (default: 127.0.0.1; 0.0.0.0: network, :: with IPv6)"
    )
    parser.add_argument("--port", type=int, help="TCP port for headsets (default: 7000; 0: a free one)")
    parser.add_argument("--router-port", type=int, help=f"port of the router (default: {ROUTER_PORT}; 0: free)")
    parser.add_argument(
        "--web-port",
        type=int,
        help=f"port for HTTP and WebSocket (default: {WEB_PORT}, or a free one where that is taken)",
    )
    parser.add_argument("--id", type=int, help=f"id of the robot (default: {DEFAULT_ROBOT})")
    parser.add_argument("--group", type=int, help="group of the robot (default: none)")
    parser.add_argument(
        "-e", "--connect", metavar="ENDPOINT", action="append", help="use this router, start none here"
    )
    options.add_settings_option(parser)


def run(args: argparse.Namespace) -> int:
    if args.once and not args.demo:
        raise UsageError("--once belongs to --demo")
    prefix_logs(supervisor.prefix("up"))
    plan = make_plan(args, options.settings_file(args))
    try:
        return running.until_stopped(lambda: _up(plan), interrupted=running.INTERRUPTED if plan.once else 0)
    finally:
        if plan.apart is not None:
            plan.apart.close()


@dataclass(frozen=True)
class Plan:
    """What to start, and where it listens: every port is known before the first program starts."""

    gateway: GatewaySettings
    robot: RobotSettings
    router_port: int | None
    """None: there is a router already."""
    routers: list[str]
    settings_files: list[str]
    apart: Apart | None
    """Where the demo is alone; None without it."""
    once: bool
    verbose: bool

    @property
    def demo(self) -> bool:
        """Whether there is a demo robot, and a headset that drives it."""
        return self.apart is not None

    def router_child(self) -> Child | None:
        """The router, on the same addresses as the gateway: nothing is open to the network unless asked for."""
        if self.router_port is None:
            return None
        host = "::" if self.gateway.host in EVERYWHERE else self.gateway.host
        return self._child("router", ["-l", endpoints.written("tcp", host, self.router_port)])

    def gateway_child(self) -> Child:
        block = [] if self.gateway.block is None else ["--block", str(self.gateway.block)]
        where = ["--host", self.gateway.host, "--port", str(self.gateway.port)]
        if self.gateway.web_port is not None and self.gateway.web_host is not None:
            where += ["--web-host", self.gateway.web_host, "--web-port", str(self.gateway.web_port)]
        return self._child("gateway", [*self._mesh(), *where, *block])

    def robot_children(self) -> list[Child]:
        robot = ["--id", str(self.robot.id), "--group", str(self.robot.group)]
        agent = self._child("agent", [*self._mesh(), *robot])
        return [Child("demo", ["bridge.cli.demo_robot"], self._environment()), agent] if self.demo else [agent]

    def _mesh(self) -> list[str]:
        namespace = [] if self.apart is None else ["--namespace", self.apart.namespace]
        return [*(word for router in self.routers for word in ("-e", router)), *namespace]

    def _child(self, verb: str, argv: list[str]) -> Child:
        common = [word for file in self.settings_files for word in ("--settings", file)]
        argv = ["bridge", verb, *common, *(["-v"] if self.verbose else []), *argv]
        return Child(verb, argv, self._environment())

    def _environment(self) -> dict[str, str] | None:
        return None if self.apart is None else self.apart.environment(os.environ)


def make_plan(args: argparse.Namespace, settings: Settings) -> Plan:
    """Settle every choice. Raises ConfigError for what is out of range, PortTaken, Unreachable."""
    gateway = changed(settings.gateway, host=args.host, port=args.port)
    routers = args.connect or settings.mesh.connect
    robot = changed(settings.robot, id=args.id or settings.robot.id or DEFAULT_ROBOT, group=args.group)
    apart = None
    if args.demo:
        apart = Apart.of(settings.mesh, own_router=not routers)
        if gateway.block is None and not gateway.blocks:
            gateway = changed(gateway, block=DEMO_BLOCK)
    try:
        chosen = gateway.port != GatewaySettings().port
        port = _port(gateway.host, gateway.port, "choose another one with --port", apart, chosen=chosen)
        router_port = None if routers else _router_port(gateway.host, args.router_port, apart)
        gateway = _with_web_port(gateway, args.web_port, apart)
    except BaseException:
        if apart is not None:
            apart.close()
        raise
    return Plan(
        gateway=changed(gateway, port=port),
        robot=robot,
        router_port=router_port,
        routers=routers or [_local_router(gateway.host, router_port)],
        settings_files=args.settings or [],
        apart=apart,
        once=args.once,
        verbose=args.verbose,
    )


def _with_web_port(gateway: GatewaySettings, wanted: int | None, apart: Apart | None) -> GatewaySettings:
    """The web port: where it is said to be, or at the usual place if there is a web server and room."""
    host = gateway.web_host or WEB_HOST
    chosen = wanted if wanted is not None else gateway.web_port
    if chosen is not None:
        port = _port(host, chosen, "choose another one with --web-port", apart, chosen=True)
    elif importlib.util.find_spec("aiohttp") is None:
        log.info("no web port: pip install 'macs-zenoh[web]'")
        return gateway
    else:
        usual = WEB_PORT if _free(host, WEB_PORT) else 0
        port = _port(host, usual, "choose another one with --web-port", apart, chosen=False)
    return changed(gateway, web_host=host, web_port=port)


def _router_port(host: str, wanted: int | None, apart: Apart | None) -> int:
    port = ROUTER_PORT if wanted is None else wanted
    advice = f"join the router there with -e {_local_router(host, port)}, or choose another port with --router-port"
    return _port(host, port, advice, apart, chosen=wanted is not None)


def _port(host: str, port: int, advice: str, apart: Apart | None, *, chosen: bool) -> int:
    """The port, if it can be listened on; a free one for 0, or for a demo whose port nobody chose. Raises
    PortTaken."""
    found = _free(host, port)
    if found is not None and (apart is None or apart.take_port(found) or chosen):
        return found
    if apart is None or (chosen and port):
        raise PortTaken(host, port, advice)
    return _port(host, 0, advice, apart, chosen=False)


def _free(host: str, port: int) -> int | None:
    """The port, if it can be listened on; a free one for 0."""
    try:
        probes = bound(host, port)
    except Unreachable:
        return None
    number: int = probes[0].getsockname()[1]
    for probe in probes:
        probe.close()
    return number


def _local_router(host: str, port: int | None) -> str:
    return endpoints.written("tcp", reachable(host), port or 0)


async def _up(plan: Plan) -> int:
    if plan.apart is not None:
        _say(
            f"The demo is alone: ROS domain {plan.apart.domain}, on this machine only; mesh {plan.apart.namespace!r}."
        )
    router, gateway, robot = plan.router_child(), plan.gateway_child(), _robot_if_possible(plan)
    needed = [router] if router else []
    others = [gateway, *robot]
    tasks: list[asyncio.Task[None]] = []
    try:
        tasks = [asyncio.create_task(child.run(), name=child.name) for child in [*needed, *others]]
        work = asyncio.create_task(_when_ready(plan, [*needed, gateway, *robot[-1:]]))
        return await _first_failure_or(work, tasks)
    finally:
        await stop_in_order([(others, 1.2), (needed, 0.5)])
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _robot_if_possible(plan: Plan) -> list[Child]:
    if importlib.util.find_spec("rclpy") is not None:
        return plan.robot_children()
    if plan.demo:
        raise Unreachable("the demo robot", "rclpy is missing: pip install 'macs-zenoh[ros]', or source your ROS 2")
    log.warning("no rclpy here, so no robot: pip install 'macs-zenoh[ros]', or source your ROS 2 installation")
    return []


async def _first_failure_or(work: asyncio.Task[int], tasks: list[asyncio.Task[None]]) -> int:
    """The result of ``work``, unless a program fails for good before."""
    try:
        await asyncio.wait([work, *tasks], return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            if task.done():
                task.result()
        return await work
    finally:
        work.cancel()
        with suppress(asyncio.CancelledError, MacsError):
            await work


async def _when_ready(plan: Plan, programs: list[Child]) -> int:
    try:
        ready = asyncio.gather(*(child.ready.wait() for child in programs))
        await within(ready, READY_S if plan.once else None)
    except asyncio.TimeoutError:
        raise NotReady([child.name for child in programs if not child.ready.is_set()], plan.routers) from None
    if plan.demo:
        from bridge.cli.demo import show

        worked = await show(reachable(plan.gateway.host), plan.gateway.port, plan.robot.id or DEFAULT_ROBOT, _say)
        if plan.once:
            return 0 if worked else 1
    _say(what_next(plan))
    await asyncio.Event().wait()
    return 0


def what_next(plan: Plan) -> str:
    """What to type now, and where to point a headset."""
    target = joined(reachable(plan.gateway.host), plan.gateway.port)
    local = plan.routers == [_local_router("127.0.0.1", ROUTER_PORT)]
    endpoint = "" if local else "".join(f" -e {router}" for router in plan.routers)
    if plan.apart is not None:
        endpoint += f" --namespace {plan.apart.namespace}"
    seen_from_outside = plan.gateway.host in EVERYWHERE
    topic = "/pose geometry_msgs/PoseStamped" if plan.demo else "/TOPIC pkg/Type"
    where = (
        joined(for_others(plan.gateway.host), plan.gateway.port)
        if seen_from_outside
        else f"{target}, from this machine only"
    )
    lines = [
        "",
        "It runs. Ctrl-C stops it; meanwhile, in another terminal:",
        f"  who is online      macs ls{endpoint}",
        f"  receive a topic    macs headset {target} sub {topic}",
        f"  drive              macs headset {target} pub /cmd_vel geometry_msgs/Twist {DRIVE}",
        f"A Unity headset connects to {where}.",
        *(_web_lines(plan) if plan.gateway.web_port is not None else []),
    ]
    if not seen_from_outside:
        lines.append("To let headsets and robots in from the network, start with --host 0.0.0.0.")
    if plan.apart is not None:
        lines.append(f"Its ROS side: {plan.apart.shown} ros2 topic list")
    return "\n".join(lines)


def _web_lines(plan: Plan) -> list[str]:
    host = plan.gateway.web_host or plan.gateway.host
    where = joined(reachable(host), plan.gateway.web_port or 0)
    secure = "s" if plan.gateway.certificate is not None and not is_local(host) else ""
    return [
        f"Watch and drive in a browser at http{secure}://{where} (programs: ws{secure}://{where}{WEBSOCKET_PATH}).",
        f"In a headset's browser: http{secure}://{where}/xr",
    ]


def _say(text: str) -> None:
    output.say_if_possible(text)
