"""What a settings file may say of `macs awareness`. Pure."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from macs_zenoh.sections import AgentId, AgentName, Bytes, Seconds, Section


class AwarenessSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Collective awareness: what this robot is called among robots, and how its messages to them travel."""

    section: ClassVar[str] = "awareness"

    name: AgentName = "drone0"
    """What others send to. It must be the only one of this name on the mesh."""
    transport: Literal["mesh", "topic", "both"] = "mesh"
    """``topic`` is the plain ROS topic that existing as2_ca gateways share within one domain."""
    id: AgentId | None = None
    """This robot's id on the mesh. Unset: lease a free one."""
    beside: bool = False
    """A robot agent with this ``id`` runs on this robot as well: the name becomes its name, and no id is taken."""
    max_bytes: Bytes = 32 * 1024 * 1024
    """A larger message is refused where it is sent."""
    max_hz: dict[str, Annotated[float, Meta(gt=0)]] = {}
    """Per message type: what is sent more often is dropped and counted."""
    deadlines_s: dict[str, Seconds] = {}
    """Per message type: how long a message to one robot may wait for it, and is repeated until it is confirmed."""
    last_values: list[str] = []
    """Message types of which every other robot's last message to all is asked for when this one joins."""
    cache: dict[str, Annotated[int, Meta(ge=1, le=100_000)]] = {}
    """Per message type: keep the last so many messages to all, for robots that miss some while the mesh is interrupted
    (docs/reliable.md)."""
    only_addressed: bool = True
    """Take only what is for this robot or for all. Off: also what the plain topic carries for others."""
    drop_own: bool = True
    """Off: what this robot sends to all on the plain topic is delivered to its own modules as well."""

    def _check(self) -> None:
        if self.beside and self.id is None:
            raise self._wrong("beside", "needs the id of the robot agent")
