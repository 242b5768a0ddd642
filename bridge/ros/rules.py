"""What a robot's settings say about a topic, service or action, by its full name. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from msgspec import structs

from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.keyexpr import block_of, type_name
from macs_zenoh.protocol.messages import UNITY
from macs_zenoh.protocol.name_patterns import matches

DEFAULT_HOLD_S = 3.0


class Rules:
    """The settings of one robot, asked by name."""

    KNOWN = 4096

    def __init__(self, settings: RobotSettings | None = None) -> None:
        self.settings = settings or RobotSettings()
        self._merged: dict[str, TopicRule] = {}
        self.stop_names = {self.settings.stop_topic} - {""}
        """Of the emergency stop: as the settings have it, and in full as on this robot's graph. Always open."""
        self.mirrored: set[str] = set()
        """Names under which this robot's graph has what is another robot's: not offered again."""

    def exposes(self, name: str) -> bool:
        """Whether agents may use, and see, what has this name."""
        if name in self.mirrored:
            return False
        if name in self.stop_names:
            return True
        allowed = any(matches(pattern, name) for pattern in self.settings.expose)
        return allowed and not any(matches(pattern, name) for pattern in self.settings.hide)

    def check_exposed(self, name: str) -> None:
        """Raise Refused when it is not exposed."""
        if not self.exposes(name):
            raise Refused(f"{name} is not open to headsets on this robot")

    def believed_group(self, agent_type: str, agent_id: int, group: int) -> int:
        """The group of an agent as far as rights go: 0 unless the settings believe that it is in the one it says."""
        believed = self.settings.groups.get(str(group), ())
        return group if names_agent(believed, agent_type, agent_id, 0) else 0

    def of(self, name: str) -> TopicRule:
        """Every setting from the first rule that fits and gives it."""
        rule = self._merged.get(name)
        if rule is None:
            if len(self._merged) >= self.KNOWN:  # names come from the network
                self._merged.clear()
            rule = self._merged[name] = _merged(rule for rule in self.settings.rules if matches(rule.match, name))
        return rule

    def call_timeout_s(self, name: str) -> float:
        """How long a service may take."""
        return self.of(name).call_timeout_s or self.settings.call_timeout_s


def _merged(rules: Iterable[TopicRule]) -> TopicRule:
    merged = TopicRule(match="/**")
    for rule in rules:
        missing = {
            field: value
            for field in rule.__struct_fields__
            if (value := getattr(rule, field)) is not None and getattr(merged, field) is None
        }
        merged = structs.replace(merged, **missing)
    return merged


def names_agent(patterns: Iterable[str], agent_type: str, agent_id: int, group: int) -> bool:
    """Whether one of ``*``, ``unity``, ``unity/5``, ``block/1`` or ``group/3`` means this agent."""
    own = {"*", agent_type, f"{agent_type}/{agent_id}"}
    if agent_type == type_name(UNITY):
        own.add(f"block/{block_of(agent_id)}")
    if group:
        own.add(f"group/{group}")
    return not own.isdisjoint(patterns)
