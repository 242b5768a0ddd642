"""Messages that a robot's settings spell out, compared with the types of the graph before anybody needs them.

A dead-man whose message has a field that the type does not have would only be found when a headset registers, and then
by the headset.
"""

from __future__ import annotations

from bridge.ros.interface import Drops
from bridge.ros.rules import Rules
from bridge.ros.side import NamesAndTypes, Side
from bridge.ros.types import InterfaceName
from macs_zenoh.errors import Refused

KNOWN = 4096
"""Names that are remembered as looked at."""


class CheckedSettings:
    """What is wrong in the messages of the rules, as far as the graph tells their types. In the ROS thread."""

    def __init__(self, side: Side, rules: Rules, drops: Drops) -> None:
        self._side = side
        self._rules = rules
        self._drops = drops
        self._seen: set[tuple[str, str]] = set()
        self.wrong: dict[str, str] = {}
        """By topic or service: why its message cannot be made."""

    def look(self, topics: NamesAndTypes, services: NamesAndTypes) -> None:
        """Look at what the graph has now; what was looked at before costs nothing."""
        for name, types in topics:
            for of_type in types:
                if self._is_new(name, of_type) and (message := self._rules.of(name).deadman_message) is not None:
                    self._try(name, of_type, "msg", message, "deadman_message")
        for name, types in services:
            for of_type in types:
                if self._is_new(name, of_type) and (message := self._rules.of(name).error_response) is not None:
                    self._try(name, of_type, "srv", message, "error_response")

    def _is_new(self, name: str, of_type: str) -> bool:
        if (name, of_type) in self._seen:
            return False
        if len(self._seen) >= KNOWN:
            self._seen.clear()
        self._seen.add((name, of_type))
        return True

    def _try(self, name: str, of_type: str, interface: str, message: dict[str, object], what: str) -> None:
        try:
            parsed = InterfaceName.parse(of_type, interface)
            kind = (
                self._side.message(parsed, name) if interface == "msg" else self._side.service(parsed, name).response
            )
        except Refused:  # not installed here: whoever registers it hears that
            return
        try:
            kind.filled(message, what)
        except Refused as refusal:
            self.wrong[name] = refusal.reason
            self._drops.note("wrong_settings", name, refusal.reason)
