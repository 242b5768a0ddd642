"""A ROS graph as the tokens of its nodes tell it. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from .keyexpr import BadToken, Endpoint, Kind, Node, parse_token

TOKENS = 100_000
"""More of one graph are not remembered."""


class Graph:
    """The nodes and endpoints whose tokens live. Deletes may come twice, and of tokens that never came."""

    def __init__(self, own: str = "") -> None:
        """``own``: the Zenoh id of the session whose endpoints are not others'."""
        self.own = own
        self.malformed = 0
        """Keys that are no tokens."""
        self.overflow = 0
        """Tokens that there was no room for."""
        self.changes = 0
        self._nodes: dict[str, Node] = {}
        self._endpoints: dict[str, Endpoint] = {}
        self._of_topic: dict[str, dict[str, Endpoint]] = {}

    def __len__(self) -> int:
        return len(self._nodes) + len(self._endpoints)

    def put(self, token: str) -> Node | Endpoint | None:
        """A token lives. What it stands for, None when that is known already or cannot be."""
        if token in self._nodes or token in self._endpoints:
            return None
        try:
            found = parse_token(token)
        except BadToken:
            self.malformed += 1
            return None
        if len(self) >= TOKENS:
            self.overflow += 1
            return None
        self.changes += 1
        if isinstance(found, Node):
            self._nodes[token] = found
        else:
            self._endpoints[token] = found
            self._of_topic.setdefault(found.topic, {})[token] = found
        return found

    def delete(self, token: str) -> Node | Endpoint | None:
        """A token is gone. What it stood for, None when there was none."""
        node = self._nodes.pop(token, None)
        if node is not None:
            self.changes += 1
            return node
        endpoint = self._endpoints.pop(token, None)
        if endpoint is None:
            return None
        self.changes += 1
        there = self._of_topic[endpoint.topic]
        del there[token]
        if not there:
            del self._of_topic[endpoint.topic]
        return endpoint

    def clear(self) -> list[Node | Endpoint]:
        """All are gone, as when there is no router any more; what they were."""
        gone: list[Node | Endpoint] = [*self._nodes.values(), *self._endpoints.values()]
        self._nodes.clear()
        self._endpoints.clear()
        self._of_topic.clear()
        self.changes += bool(gone)
        return gone

    def nodes(self, *, others: bool = False) -> list[Node]:
        """All nodes; ``others``: but our own."""
        return [node for node in list(self._nodes.values()) if not (others and node.zid == self.own)]

    def endpoints(self, *kinds: Kind, others: bool = False) -> list[Endpoint]:
        """All endpoints of these kinds; ``others``: but our own."""
        return list(self._chosen(list(self._endpoints.values()), kinds, others))

    def on(self, topic: str, *kinds: Kind, others: bool = False) -> list[Endpoint]:
        """The endpoints of a topic or service."""
        return list(self._chosen(list(self._of_topic.get(topic, {}).values()), kinds, others))

    def names_and_types(self, *kinds: Kind) -> list[tuple[str, list[str]]]:
        """Each name that has such an endpoint, with its types, sorted."""
        found: dict[str, set[str]] = {}
        for endpoint in self.endpoints(*kinds):
            if endpoint.type:
                found.setdefault(endpoint.topic, set()).add(endpoint.type)
        return [(name, sorted(types)) for name, types in sorted(found.items())]

    def _chosen(self, endpoints: Iterable[Endpoint], kinds: tuple[Kind, ...], others: bool) -> Iterator[Endpoint]:
        for endpoint in endpoints:
            if (not kinds or endpoint.kind in kinds) and not (others and endpoint.node.zid == self.own):
                yield endpoint
