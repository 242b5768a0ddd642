"""What the check expects of a policy: who speaks as whom, who is reached, seen and known; an agent of each. Pure."""

from __future__ import annotations

from bridge.security import access
from bridge.security.policy import Client, Gateway, Operator, Policy, Robot
from macs_zenoh.protocol.keyexpr import FieldValue


class Expected:
    """The policy's answers. What two gateways without blocks may do is one thing: their headsets are one crowd."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def speaks_as(self, one: Client, other: Client) -> bool:
        """Whether a node may send in the name of another's sample agent."""
        if one is other:
            return True
        if isinstance(one, Gateway) and isinstance(other, Gateway):
            return not one.blocks or (not other.blocks and 255 in one.blocks)
        return self._both_nobody(one, other)

    def has_inbox(self, one: Client, other: Client) -> bool:
        """Whether a node gets what is sent to another's sample agent."""
        return one is other or (isinstance(one, Gateway) and isinstance(other, Gateway) and self.speaks_as(one, other))

    def reaches(self, one: Client, other: Client) -> bool:
        """Whether a node's agents may send to another's: those who have an inbox."""
        return bool(access.inboxes(other)) and (one is other or access.reaches(self.policy, one, other))

    def sees(self, one: Client, other: Client) -> bool:
        """Whether a node may know that another's sample agent is online."""
        return (
            isinstance(one, Operator)
            or one is other
            or self.policy.related(one, other)
            or (isinstance(one, Gateway) and self.has_inbox(one, other))
        )

    def knows_name(self, one: Client, other: Client) -> bool:
        """Whether a node may know of another's name and what is taken under it."""
        if isinstance(one, Operator) or one is other:
            return True
        both = access.awareness_name(one) is not None and access.awareness_name(other) is not None
        return both and access.converse(self.policy, one, other)

    def writes_to(self, one: Client, other: Client) -> bool:
        """Whether a named node may send to another by name."""
        both = access.awareness_name(one) is not None and access.awareness_name(other) is not None
        return both and one is not other and self.policy.may(one, "message", other)

    def limited_verbs(self) -> list[str]:
        """Verbs that some may call of somebody who may not call all: real ones, which robots serve as well."""
        found: dict[str, None] = {}
        for one in self.policy.clients:
            for other in self.policy.clients:
                found.update(dict.fromkeys(self.policy.verbs(one, other) or ()))
        return list(found)

    @staticmethod
    def _both_nobody(one: Client, other: Client) -> bool:
        """Operators without an id are one: ``operator/0``."""
        return isinstance(one, Operator) and isinstance(other, Operator) and one.id is None and other.id is None


def agent_of(client: Client) -> dict[str, FieldValue]:
    """One agent that a node speaks for: of a gateway the last id, which is least in use."""
    found = access.agents(client)[-1]
    return found if "id" in found else {**found, "id": 0xFFFF}


def sender_of(client: Client) -> dict[str, FieldValue]:
    """That agent as the end of a key."""
    return {f"from_{name}": value for name, value in agent_of(client).items()}


def presence_of(client: Client) -> dict[str, FieldValue]:
    """That agent as fields of `PRESENCE`, in its group; a headset in none."""
    return {**agent_of(client), "group": client.group if isinstance(client, Robot) else 0}
