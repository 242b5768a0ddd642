"""What a settings file may say of `macs rmw-zenoh`: the robots that it presents. Pure."""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta

from macs_zenoh.protocol import endpoints
from macs_zenoh.sections import AgentId, GroupId, Section, in_words

DomainId = Annotated[int, Meta(ge=0, le=232)]
"""A ROS domain."""
Namespace = Annotated[
    str,
    Meta(pattern=r"^(/|(/[A-Za-z_]\w*)+)$", max_length=256, extra=in_words("a namespace of ROS, as /robot7")),
]
SessionNamespace = Annotated[
    str,
    Meta(
        pattern=r"^([^/*$?#@\s]+(/[^/*$?#@\s]+)*)?$",
        max_length=256,
        extra=in_words("a plain key, as robot7, or nothing"),
    ),
]


class RmwZenohRobot(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot whose nodes run rmw_zenoh; one ``[[rmw_zenoh.robots]]`` table."""

    section: ClassVar[str] = "rmw_zenoh.robots"

    id: AgentId
    """Its id on the mesh."""
    group: GroupId = 0
    """The group that it is in, 1 to 255. 0: in none."""
    domain: DomainId = 0
    """Its ``ROS_DOMAIN_ID``."""
    node_namespace: Namespace = "/"
    """The namespace that its nodes are in, where several robots share a domain."""
    session_namespace: SessionNamespace = ""
    """The namespace of its Zenoh sessions (``ZENOH_CONFIG_OVERRIDE='namespace="robot7"'``), which access rules can
    hold it to."""

    @property
    def place(self) -> str:
        """Where its nodes are, in words."""
        parts = [f"domain {self.domain}"]
        if self.node_namespace != "/":
            parts.append(f"namespace {self.node_namespace}")
        if self.session_namespace:
            parts.append(f"session namespace {self.session_namespace}")
        return ", ".join(parts)


class RmwZenohSettings(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Robots that run ROS 2's own Zenoh middleware. What else holds for them is in ``[robot]``."""

    section: ClassVar[str] = "rmw_zenoh"

    connect: list[str] = []
    """The routers that the robots' nodes are linked with, tried in order. Empty: those of the mesh."""
    robots: list[RmwZenohRobot] = []
    """Each a ``[[rmw_zenoh.robots]]`` table."""
    first_id: AgentId = 1
    """With ``--all``: the id of the robot in ROS domain 0; that of domain 5 is 5 higher. A namespace's robot has the
    number at the end of its name, also where that would be a domain's."""
    definitions: list[str] = []
    """Folders with ``.msg``, ``.srv`` and ``.action`` files, for types that rosbags does not bring and that the robots
    do not describe."""

    def _check(self) -> None:
        for endpoint in self.connect:
            if problem := endpoints.problem(endpoint):
                raise self._wrong("connect", f"{endpoint!r} {problem}")
        ids = [robot.id for robot in self.robots]
        for number, robot in enumerate(self.robots):
            if robot.id in ids[:number]:
                raise self._wrong(f"robots[{number}].id", f"{robot.id} is another robot's as well")
