"""One headset that performs the verbs of ``macs headset``.

A verb is done in two steps. The first is quick and in order: register, so that the next line of a script can
rely on it. The second is the *job* that remains: take messages, publish, wait for an answer. The command line runs
that job to its end; a script may leave it in the background.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Coroutine, Mapping, Sequence
from typing import Any, NamedTuple

from macs_zenoh.errors import MacsError, Unreachable, UsageError
from macs_zenoh.protocol.robot_state import STATUS
from macs_zenoh.timeouts import within
from macs_zenoh.typed import Types, part_of_action, request_of, response_of

from .actions import ABORTED, CANCELED, SUCCEEDED, Goal
from .client import Headset
from .hints import Role, hints, offered_type
from .nodes import Node, Service, ServiceRequest, Subscription
from .shown import json_or_text, shown_message, shown_request, shown_topic
from .taking import only_from, unless_refused, until_ended
from .verbs import MAX_BYTES, TYPE_IS_OPTIONAL, agent_type, json_object

log = logging.getLogger("macs.headset")

_LISTEN = "listen"
_LAST_MESSAGES_S = 0.2
"""How long `pub` stays after its last message: leaving at once takes the publisher off the robot before ROS has
carried the message."""
_SILENCE_S = 2.0
"""How long `sub` waits for a first message before it says where nobody publishes the topic."""
_CONFIRM_S = 1.0
"""How long a robot may take, after the last message of `pub`, until it is clear that it refused none of them."""
_RETRY_S = 0.1
"""How often `pub` looks whether a lost connection is back."""

GOAL_STATUS = {SUCCEEDED: "succeeded", CANCELED: "canceled", ABORTED: "aborted"}

Emit = Callable[[dict[str, Any]], None]
"""Takes one result, an object for one line of JSON."""


class Job(NamedTuple):
    """What remains of a verb. ``endless``: nothing but a stop ends it."""

    work: Coroutine[Any, Any, int]
    endless: bool = False


class Session:
    """One headset and the verbs that it performs. ``emit`` takes each result, an object for one JSON line."""

    def __init__(self, emit: Emit, definitions: Sequence[str] = ()) -> None:
        self._endless = False
        self._node: Node | None = None
        self._silent: set[int] = set()
        self._emit = emit
        self._definitions = definitions
        self._types: Types | None = None
        self._headset: Headset | None = None
        self._received: Counter[str] = Counter()
        self._progress = asyncio.Event()

    @property
    def stopped_code(self) -> int:
        """The exit code when somebody stops the verb that was started last: success for one without an end of its own,
        unless robots refuse what it does."""
        if not self._endless:
            return 130
        return 1 if self._node is not None and self._node.refusing() else 0

    @property
    def headset(self) -> Headset:
        """The headset. Raises UsageError before there is one."""
        if self._headset is None:
            raise UsageError("not connected yet")
        return self._headset

    def use(self, headset: Headset) -> None:
        """Perform with this headset."""
        self._headset = headset

    def prepare(self, args: argparse.Namespace) -> None:
        """Find out before connecting what is wrong with a verb's types and values. Raises UsageError."""
        verb = args.headset_verb
        if verb in TYPE_IS_OPTIONAL and not _type_is_given(args):
            json_object(getattr(args, "json", "{}"))
        elif verb == "sub" and not args.raw:
            self.types.serialize(args.type, {})
        elif verb == "pub":
            self._message(args, 0)
        elif verb == "call":
            self.types.serialize(request_of(args.type), json_object(args.json))
        elif verb == "serve":
            self.types.serialize(response_of(args.type), json_object(args.json))
        elif verb == "goal":
            self.types.serialize(part_of_action(args.type, "Goal"), json_object(args.json))
        elif verb == "ask":
            json_object(args.json)
        elif verb == "send":
            _check_receivers(args)

    async def start(self, args: argparse.Namespace) -> Job:
        """Do the quick part of a verb and return the rest. Raises UsageError, Unreachable."""
        if args.headset_verb in TYPE_IS_OPTIONAL and not _type_is_given(args):
            await self._find_type(args)
        self.prepare(args)
        starts: dict[str, Callable[[argparse.Namespace], Awaitable[Job]]] = {
            "online": self._online,
            "sub": self._sub,
            "pub": self._pub,
            "call": self._call,
            "serve": self._serve,
            "goal": self._goal,
            "ask": self._ask,
            "send": self._send,
            "listen": self._listen,
        }
        self._node = None
        job = await starts[args.headset_verb](args)
        self._endless = job.endless
        return job

    @property
    def types(self) -> Types:
        """The message definitions, loaded at first use. Raises MissingRosbags."""
        if self._types is None:
            self._types = Types(self._definitions)
        return self._types

    async def wait_for(self, what: str, count: int) -> None:
        """Wait until ``what`` (a topic, a service or ``listen``) has had ``count`` messages since the beginning."""
        while self._received[what] < count:
            self._progress.clear()
            await self._progress.wait()

    # --- verbs ---

    async def _online(self, _args: argparse.Namespace) -> Job:
        async def work() -> int:
            reply = await self.headset.online()
            self._emit({"id": self.headset.id, "ros": reply.ros_agent_ids, "unity": reply.unity_agent_ids})
            return 0

        return Job(work())

    async def _sub(self, args: argparse.Namespace) -> Job:
        subscription = await self.headset.subscribe(
            args.topic,
            args.type,
            agents=await self._robots(args),
            groups=args.groups,
            buffer_size=args.buffer,
            drop_new=args.drop_new,
        )
        self._node = subscription
        log.info("subscribed to %s of robots %s", args.topic, _where(subscription))

        async def work() -> int:
            there = await self._there(subscription)
            async with self._hint(args.topic, there, "publishers", groups=args.groups, after_s=_SILENCE_S):
                return await self._take(
                    subscription, args.topic, args, lambda item: shown_topic(self.types, args, item), subscription
                )

        return Job(work(), endless=not (args.count or args.timeout))

    async def _pub(self, args: argparse.Namespace) -> Job:
        agents = await self._robots(args)
        known = {node.spec.tos_name for node in self.headset.nodes}
        publisher = await self.headset.advertise(
            args.topic, args.type, agents=agents, groups=args.groups, latched=args.latched
        )
        self._node = publisher
        count = args.count or (0 if args.rate else 1)
        new = args.topic not in known
        settle_s = args.settle if new else 0.0

        async def work() -> int:
            there = await self._there(publisher, agents)
            if args.timed:
                await self._tell_times(there, args.groups)
            async with self._hint(args.topic, there if new else (), "subscribers") as hinted:
                await asyncio.sleep(settle_s)
                sent = await publish()
                if not await self._reaches(there, hinted):
                    await asyncio.sleep(_LAST_MESSAGES_S)
            return self._published(args, sent, self._refusals(publisher, agents, there, hinted.said))

        async def publish() -> int:
            sent = 0
            began = time.monotonic()
            while (not count or sent < count) and not publisher.refused_everywhere:
                try:
                    await publisher.publish(self._message(args, sent), agents=agents, groups=args.groups)
                except Unreachable:
                    if not self.headset.reconnecting:
                        raise
                    if not args.rate:
                        await asyncio.sleep(_RETRY_S)
                        continue
                sent += 1
                if args.rate and sent != count:
                    await asyncio.sleep(began + sent / args.rate - time.monotonic())
            return sent

        return Job(work(), endless=not count)

    async def _tell_times(self, robots: Collection[int], groups: Collection[int]) -> None:
        for robot in sorted(set(robots) - await self.headset.tell_times(robots, groups)):
            log.warning("robot %d does not judge commands by the time at which they were made", robot)

    def _published(self, args: argparse.Namespace, sent: int, refusals: dict[int, str]) -> int:
        """Say what came of `pub`. What some robots refused was sent; whether all of it was lost there is not known."""
        if not refusals:
            self._emit({"topic": args.topic, "published": sent})
            if args.groups:  # a headset is not told who is in which group
                named = ", ".join(map(str, args.groups))
                log.warning("sent to all robots of group %s, if there are any: macs ls shows the groups", named)
            return 0
        refused = [{"robot": robot, "reason": reason} for robot, reason in sorted(refusals.items())]
        self._emit({"topic": args.topic, "sent": sent, "refused": refused})
        return 1

    def _refusals(
        self, node: Node, agents: Collection[int], there: Collection[int], hinted: Mapping[int, str]
    ) -> dict[int, str]:
        """Why robots do not take what was published: by what they say, or because they cannot."""
        absent = {robot: "it is not online" for robot in agents if robot not in there}
        said = {robot: reason for robot, reason in node.refusing().items() if not agents or robot in agents}
        return {**absent, **hinted, **said}

    async def _there(self, node: Node, agents: Collection[int] = ()) -> set[int]:
        """Which of the robots that a verb names are online. Tells of the others."""
        named = set(agents or node.agents)
        if not named:
            return named
        there = named & set((await self.headset.online()).ros_agent_ids)
        for robot in sorted(named - there):
            log.warning("robot %d is not online: it is asked for %s when it comes", robot, node.spec.tos_name)
        return there

    async def _reaches(self, robots: Collection[int], hinted: Hinted) -> bool:
        """Whether all robots have answered something that was sent now, and so all that was sent before: a refusal of
        that has come before the answer. Robots that do not answer are not asked again."""
        await hinted.wait()

        async def answers(robot: int) -> None:
            try:
                await self.headset.ask(robot, STATUS, timeout_s=_CONFIRM_S)
            except Unreachable:  # an existing program, say
                self._silent.add(robot)

        asked = [robot for robot in robots if robot not in self._silent]
        await asyncio.gather(*map(answers, asked))
        return bool(robots) and not self._silent & set(robots)

    async def _call(self, args: argparse.Namespace) -> Job:
        request = self.types.serialize(request_of(args.type), json_object(args.json))
        agent = args.agent or await self._only_robot()

        async def work() -> int:
            if agent not in (await self.headset.online()).ros_agent_ids:
                raise Unreachable(f"robot {agent}", "it is not online")
            began = time.monotonic()
            cdr = await self.headset.call(args.topic, args.type, agent, request, timeout_s=args.timeout, failures=True)
            took_ms = round((time.monotonic() - began) * 1000, 2)
            response = self.types.deserialize(response_of(args.type), cdr, max_bytes=MAX_BYTES)
            self._emit({"service": args.topic, "from": agent, "response": response, "ms": took_ms})
            return 0

        return Job(work())

    async def _serve(self, args: argparse.Namespace) -> Job:
        response = self.types.serialize(response_of(args.type), json_object(args.json))
        requests: asyncio.Queue[ServiceRequest] = asyncio.Queue()

        def answer(request: ServiceRequest) -> bytes:
            requests.put_nowait(request)
            return response

        service = await self.headset.serve(
            args.topic, args.type, answer, agents=await self._robots(args), groups=args.groups
        )
        self._node = service
        log.info("serving %s for robots %s", args.topic, _where(service))
        taken = until_ended(self.headset, requests)

        async def work() -> int:
            await self._there(service)
            return await self._take(
                taken, args.topic, args, lambda request: shown_request(self.types, args, request), service
            )

        return Job(work(), endless=not (args.count or args.timeout))

    async def _goal(self, args: argparse.Namespace) -> Job:
        goal_cdr = self.types.serialize(part_of_action(args.type, "Goal"), json_object(args.json))
        agent = args.agent or await self._only_robot()
        client = await self.headset.action(args.topic, args.type, agents=[agent])
        line = {"action": args.topic, "from": agent}

        async def steps(goal: Goal) -> None:
            feedback = part_of_action(args.type, "Feedback")
            async for cdr in goal:
                self._emit({**line, "feedback": self.types.deserialize(feedback, cdr, max_bytes=MAX_BYTES)})

        async def is_there(robot: int) -> bool:
            return robot in (await self.headset.online()).ros_agent_ids

        async def work() -> int:
            if not await is_there(agent):
                raise Unreachable(f"robot {agent}", "it is not online")
            began = time.monotonic()
            goal = await client.send_goal(agent, goal_cdr)
            following = asyncio.create_task(goal.follow(is_there))
            try:
                await within(steps(goal), args.timeout)
            except asyncio.TimeoutError:
                await goal.cancel()
            except asyncio.CancelledError:
                with contextlib.suppress(MacsError):  # nobody looks after it any more
                    await asyncio.shield(goal.cancel(timeout_s=1.0))
                raise
            finally:
                following.cancel()
            status, cdr = await goal.result(timeout_s=5.0)
            took_ms = round((time.monotonic() - began) * 1000, 2)
            result = self.types.deserialize(part_of_action(args.type, "Result"), cdr, max_bytes=MAX_BYTES)
            self._emit({**line, "status": GOAL_STATUS.get(status, str(status)), "result": result, "ms": took_ms})
            return 0 if status == SUCCEEDED else 1

        return Job(work())

    async def _ask(self, args: argparse.Namespace) -> Job:
        data = json_object(args.json)

        async def work() -> int:
            if args.agent is None:
                answer = await self.headset.ask_gateway(args.manager, data, timeout_s=args.timeout)
            else:
                if args.agent not in (await self.headset.online()).ros_agent_ids:
                    raise Unreachable(f"robot {args.agent}", "it is not online")
                encoded = json.dumps(data).encode()
                answer = await self.headset.ask(args.agent, args.manager, encoded, timeout_s=args.timeout)
            shown = json_or_text(answer)
            self._emit({"manager": args.manager, "from": args.agent or "gateway", "answer": shown})
            refused = isinstance(shown, dict) and (shown.get("done") is False or "refused" in shown)
            return 1 if refused else 0

        return Job(work())

    async def _send(self, args: argparse.Namespace) -> Job:
        async def work() -> int:
            data = args.text.encode()
            self.headset.forbidden.clear()
            await self.headset.send(
                data, to=agent_type(args.to), ids=args.ids, groups=args.groups, manager=args.manager
            )
            sent = {"to": args.to, "ids": args.ids, "groups": args.groups, "bytes": len(data)}
            online = await self.headset.online()
            there = {"ros": online.ros_agent_ids, "unity": online.unity_agent_ids}.get(args.to, [])
            if self.headset.forbidden:
                self._emit({**sent, "refused": self.headset.forbidden[-1].reason})
                return 1
            absent = [number for number in args.ids if number not in there]
            self._emit({**sent, "absent": absent} if absent else sent)
            return 1 if absent else 0

        return Job(work())

    async def _listen(self, args: argparse.Namespace) -> Job:
        messages = only_from(args.sender, self.headset)
        work = self._take(messages, _LISTEN, args, lambda message: shown_message(message, full=args.full))
        return Job(work, endless=not (args.count or args.timeout))

    # --- inside ---

    @contextlib.asynccontextmanager
    async def _hint(
        self, topic: str, robots: Collection[int], role: Role, *, groups: Collection[int] = (), after_s: float = 0
    ) -> AsyncIterator[Hinted]:
        """Meanwhile, if nothing has been received by then, say what may be wrong."""

        async def hint() -> None:
            await asyncio.sleep(after_s)
            if not self._received[topic]:
                hinted.said.update(await hints(self.headset, robots, topic, role))
                for line in hinted.said.values():
                    log.warning("%s", line)
                if groups:  # a headset is not told who is in which group
                    named = ", ".join(map(str, groups))
                    log.warning("nothing from group %s yet; is a robot in it? macs ls shows the groups", named)

        hinted = Hinted(hinting := asyncio.get_running_loop().create_task(hint()), {})
        try:
            yield hinted
        finally:
            hinting.cancel()

    async def _take(
        self,
        source: AsyncIterator[Any],
        what: str,
        args: argparse.Namespace,
        show: Callable[[Any], dict[str, Any]],
        node: Node | None = None,
    ) -> int:
        """Emit what ``source`` gives until there were ``--count`` or ``--timeout`` has passed.

        Raises Refused when every robot has refused ``node``: nothing will ever come.
        """
        taken = 0

        async def take() -> None:
            nonlocal taken
            async for item in source:
                self._emit(show(item))
                taken += 1
                self._received[what] += 1
                self._progress.set()
                if taken == args.count:
                    return
            if self.headset.why_ended:
                raise Unreachable(self.headset.target, self.headset.why_ended)

        try:
            await within(unless_refused(take(), node), args.timeout)
        except asyncio.TimeoutError:
            log.info("%s: %d within %g s", what, taken, args.timeout)
            return 0 if taken and not args.count else 1
        return 0 if not args.count or taken == args.count else 1  # `unsub` in a script ends it early

    async def _robots(self, args: argparse.Namespace) -> Collection[int]:
        """The robots that a verb names, by default all that are online."""
        agents: list[int] = args.agents
        if agents or args.groups:
            return agents
        online = (await self.headset.online()).ros_agent_ids
        if not online:
            raise Unreachable("any robot", "none is online (name robots that come later with --agents)")
        return online

    async def _find_type(self, args: argparse.Namespace) -> None:
        """Of what a verb names without its type."""
        json_object(getattr(args, "json", "{}"))
        robots = [args.agent] if getattr(args, "agent", None) else getattr(args, "agents", [])
        online = (await self.headset.online()).ros_agent_ids
        asked = [robot for robot in robots or online if robot in online]
        args.type = await offered_type(self.headset, asked, args.topic, args.headset_verb)
        log.info("%s has type %s", args.topic, args.type)

    async def _only_robot(self) -> int:
        online = (await self.headset.online()).ros_agent_ids
        if not online:
            raise Unreachable("any robot", "none is online")
        if len(online) > 1:
            raise UsageError(f"robots {online} are online: choose one with --agent")
        return online[0]

    def _message(self, args: argparse.Namespace, number: int) -> bytes:
        return self.types.serialize(args.type, json_object(args.json.replace("$i", str(number))))


class Hinted(NamedTuple):
    """A hint while it is found out: ``said`` by robot, once `wait` is over."""

    finding: asyncio.Task[None]
    said: dict[int, str]

    async def wait(self) -> None:
        """Until it is known, or known that nobody says."""
        await asyncio.wait([self.finding])


def _check_receivers(args: argparse.Namespace) -> None:
    """On the wire type 0 goes to everybody whatever else is named, which nobody means who names somebody."""
    named = bool(args.ids or args.groups)
    if args.to == "all" and named:
        raise UsageError("--to all goes to everybody: leave out --ids and --groups, or say --to ros or --to unity")
    if args.to != "all" and not named:
        raise UsageError(f"to which agents of type {args.to}? Give --ids or --groups (or --to all)")


def _where(node: Subscription | Service) -> str:
    groups = f" and groups {sorted(node.groups)}" if node.groups else ""
    return f"{sorted(node.agents)}{groups}"


def _type_is_given(args: argparse.Namespace) -> bool:
    """Whether a verb names a type. What stands in its place may be the JSON behind it."""
    if args.type is not None and args.type.lstrip().startswith("{"):
        args.json, args.type = args.type, None
    if getattr(args, "json", "{}") is None:
        raise UsageError(f"what to publish to {args.topic} is missing: a JSON object, as '{{\"data\": 1}}'")
    return args.type is not None
