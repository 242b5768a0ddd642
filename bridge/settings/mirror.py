"""What a settings file may say of topics and services of other robots in this robot's ROS graph. Pure."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from macs_zenoh.sections import Section, in_words

FullName = Annotated[
    str,
    Meta(
        pattern=r"^(/[A-Za-z_]\w*)+$",
        max_length=256,
        extra=in_words("a full name that begins with /, as /camera/image"),
    ),
]
Source = Annotated[
    str,
    Meta(pattern=r"^(ros/[0-9]{1,5}|group/[0-9]{1,3})$", extra=in_words("a robot or a group, as ros/1 or group/3")),
]
NAME, ROBOT = "{topic}", "{robot}"


class MirrorRule(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics and services of another robot, or of a group's, in this robot's graph; one ``[[robot.mirror]]``."""

    section: ClassVar[str] = "robot.mirror"

    source: Source = msgspec.field(name="from")
    """Whose: ``ros/1``, or ``group/3``."""
    topics: list[FullName] = []
    """Their names on the other robot."""
    services: list[FullName] = []
    """The same."""
    name: Annotated[str, Meta(max_length=256)] = msgspec.field(name="as", default="/robot{robot}{topic}")
    """Their names here: ``{topic}`` stands for the name there, ``{robot}`` for the other robot's id."""
    tf_prefix: Annotated[str, Meta(max_length=64)] = ""
    """Before each frame of topics of transforms (tf2_msgs/TFMessage), as ``robot{robot}/``. They have a name of their
    own here as all others; tf2 listens to ``/tf`` alone unless it is remapped."""
    replays: bool = False
    """Mirror a recording that is played under that id as well (`macs replay`): its poses and transforms are old."""

    def _check(self) -> None:
        if NAME not in self.name:
            raise self._wrong("as", f"{self.name!r} has no {NAME}: all would have one name")
        if self.source.startswith("group/") and ROBOT not in self.name:
            raise self._wrong("as", f"{self.name!r} has no {ROBOT}: all robots of the group would have one name")
        shown = self.name.replace(ROBOT, "1").replace(NAME, "/x")
        if not re.fullmatch(r"(/[A-Za-z_]\w*)+", shown, re.ASCII) or shown == "/x":
            raise self._wrong("as", f"{self.name!r} makes no other full name of /x")

    @property
    def by_id(self) -> bool:
        """Whether it names one robot, and no group that anybody may be in."""
        return self.source.startswith("ros/")

    def means(self, robot: int, group: int) -> bool:
        """Whether a robot is one of those."""
        kind, _, number = self.source.partition("/")
        return int(number) == (robot if kind == "ros" else group)

    def name_of(self, topic: str, robot: int) -> str:
        """What a topic or service of a robot is called here."""
        return self.name.replace(ROBOT, str(robot)).replace(NAME, topic)
