"""What robots have, as lists: topics, services and actions, with their types and the robots that have them. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from macs_zenoh.protocol.robot_state import NodeStatus, Offered, RobotStatus, TopicQos
from macs_zenoh.protocol.schemas import DefinitionsReply

HIDDEN = ("/parameter_events", "/rosout")
"""Topics that every ROS node has; nobody looks for them here."""


@dataclass
class Topic:
    """One topic of some robots."""

    name: str
    types: set[str] = field(default_factory=set)
    publishers: list[int] = field(default_factory=list)
    subscribers: list[int] = field(default_factory=list)

    @property
    def type(self) -> str:
        return ", ".join(sorted(self.types))

    def facts(self) -> dict[str, Any]:
        """For programs."""
        return {
            "topic": self.name,
            "type": self.type,
            "publishers": self.publishers,
            "subscribers": self.subscribers,
        }


@dataclass
class Named:
    """A service or an action of some robots."""

    name: str
    types: set[str] = field(default_factory=set)
    robots: list[int] = field(default_factory=list)

    @property
    def type(self) -> str:
        return ", ".join(sorted(self.types))

    def facts(self, what: str) -> dict[str, Any]:
        """For programs."""
        return {what: self.name, "type": self.type, "robots": self.robots}


def topics(offers: Mapping[int, Offered]) -> list[Topic]:
    """Every topic, by name."""
    found: dict[str, Topic] = {}
    for robot, offered in sorted(offers.items()):
        for table, end in ((offered.publishers, "publishers"), (offered.subscribers, "subscribers")):
            for name, of_type in table.items():
                topic = found.setdefault(name, Topic(name))
                topic.types.add(of_type)
                getattr(topic, end).append(robot)
    return [found[name] for name in sorted(found)]


def services(offers: Mapping[int, Offered]) -> list[Named]:
    """Every service, by name."""
    return _named((robot, offered.services) for robot, offered in sorted(offers.items()))


def actions(offers: Mapping[int, Offered]) -> list[Named]:
    """Every action, by name."""
    return _named((robot, offered.actions) for robot, offered in sorted(offers.items()))


def _named(tables: Iterable[tuple[int, Mapping[str, str]]]) -> list[Named]:
    found: dict[str, Named] = {}
    for robot, table in tables:
        for name, of_type in table.items():
            named = found.setdefault(name, Named(name))
            named.types.add(of_type)
            named.robots.append(robot)
    return [found[name] for name in sorted(found)]


def about_topic(name: str, offers: Mapping[int, Offered], states: Mapping[int, RobotStatus]) -> dict[str, Any]:
    """All that robots tell of one topic, for programs; without ``robots`` nobody has it."""
    known = {topic.name: topic for topic in topics(offers)}.get(name, Topic(name))
    robots = []
    for robot, offered in sorted(offers.items()):
        if name not in offered.publishers and name not in offered.subscribers:
            continue
        state = states.get(robot)
        nodes = [node for node in state.nodes if node.name == name] if state is not None else []
        qos = offered.qos.get(name, TopicQos())
        robots.append(
            {
                "robot": robot,
                "publishes": name in offered.publishers,
                "subscribes": name in offered.subscribers,
                "reliability": qos.reliability,
                "durability": qos.durability,
                "registered": {node.role: node.registrants for node in nodes if node.registrants},
                "control": _holder(nodes),
            }
        )
    return {**known.facts(), "robots": robots}


def types_at(name: str, offers: Mapping[int, Offered]) -> dict[int, str]:
    """The type of a topic, by robot that has it."""
    found = {robot: offered.publishers.get(name) or offered.subscribers.get(name) for robot, offered in offers.items()}
    return {robot: of_type for robot, of_type in sorted(found.items()) if of_type}


def definitions(told: Mapping[int, DefinitionsReply]) -> list[dict[str, Any]]:
    """How robots define types, for programs; those that define them alike are together."""
    alike: dict[bytes, list[int]] = {}
    for robot, reply in told.items():
        alike.setdefault(msgspec.json.encode([reply.definitions, reply.missing]), []).append(robot)
    found = []
    for text, robots in alike.items():
        types, missing = msgspec.json.decode(text)
        found.append({"robots": robots, "types": types, "missing": missing})
    return found


def shown_definitions(told: Mapping[int, DefinitionsReply]) -> list[str]:
    """The same for people."""
    lines = []
    for each in definitions(told):
        robots = ", ".join(map(str, each["robots"]))
        lines += ["", f"Definition (robot{'' if len(each['robots']) == 1 else 's'} {robots}):"]
        for name, definition in each["types"].items():
            lines.append(f"  {name} {definition['hash']}".rstrip())
            lines += [f"    {line}" for line in definition["text"].splitlines()]
        lines += [f"  {name}: {why}" for name, why in each["missing"].items()]
    return lines


def _holder(nodes: Iterable[NodeStatus]) -> str | None:
    for node in nodes:
        if (control := node.control) and control.holder:
            return control.holder
    return None


def shown_topic(about: Mapping[str, Any], *, verbose: bool) -> list[str]:
    """The same for people, as ``ros2 topic info`` has it. Counted are robots, which do not tell of their nodes."""
    lines = [f"Type: {about['type']}"]
    for what, robots in (("Publisher", about["publishers"]), ("Subscription", about["subscribers"])):
        where = f" (robot{'' if len(robots) == 1 else 's'} {', '.join(map(str, robots))})" if robots else ""
        lines.append(f"{what} count: {len(robots)}{where}")
    for robot in about["robots"] if verbose else ():
        lines += ["", f"Robot: {robot['robot']}"]
        ends = [end for end, has in (("publishes", robot["publishes"]), ("subscribes", robot["subscribes"])) if has]
        lines.append(f"  ROS nodes: {' and '.join(ends)}")
        lines.append("  QoS profile:")
        for policy in ("reliability", "durability"):
            lines.append(f"    {policy.capitalize()}: {(robot[policy] or 'unknown').upper()}")
        for role, registrants in robot["registered"].items():
            lines.append(f"  Registered as {role}: {', '.join(registrants)}")
        if robot["control"]:
            lines.append(f"  Control: {robot['control']}")
    return lines
