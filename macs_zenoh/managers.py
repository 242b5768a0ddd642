"""Own management messages: a class named like its ``messageManager``, listed by whoever runs the program.

A manager's class name is the name on the wire, its module the same in snake case: ``WorldClassManager`` lives in
``world_class_manager``. It says what data it takes (a msgspec struct) and returns what to answer, or nothing::

    class WorldClassManager(Manager):
        class Data(msgspec.Struct, rename="camel"):
            question: str

        def manage(self, data: Data, asker: Asker) -> Answer | None: ...

Nothing is ever imported because a message names it: only what the settings list, or installed packages offer as an
entry point in the group ``macs.managers``, and only by `load`, once, at the start.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, ClassVar, NamedTuple

from msgspec import Struct

from .errors import ConfigError
from .protocol.messages import MANAGERS

GROUP = "macs.managers"
"""Entry-point group in which packages offer managers."""


class Asker(NamedTuple):
    """Who sent a management message: the truth of its connection or key, not what its JSON says."""

    type: int
    id: int
    group: int


class Manager(ABC):
    """Handles the management messages that carry its class's name. One instance serves all agents."""

    Data: ClassVar[type[Struct]]
    """What the message's JSON must be: on a gateway the management data, on a robot the message's data."""

    @abstractmethod
    def manage(self, data: Any, asker: Asker) -> Struct | None:
        """Do the work, quickly: the program does nothing else meanwhile. What is returned answers the asker.

        Raise Refused to log why not; the asker then gets no answer.
        """


Managers = Mapping[str, Manager]
"""Managers by their name on the wire."""


def load(listed: Iterable[str], *, offered: bool = True) -> Managers:
    """Import and create managers: those listed as ``module:Class``, and (``offered``) those of entry points.

    Raises ConfigError: cannot be imported, is no Manager, breaks the naming rule, or takes a name that is taken.
    """
    found: dict[str, Manager] = {}
    places = [(name, name) for name in listed]
    if offered:
        places += [(f"entry point {point.name}", point.value) for point in entry_points(group=GROUP)]
    for origin, place in places:
        manager = _create(origin, place)
        name = type(manager).__name__
        if name in found or name in MANAGERS:
            raise ConfigError(origin, f"there is a manager called {name} already")
        found[name] = manager
    return found


def _create(origin: str, place: str) -> Manager:
    module_name, _, class_name = place.partition(":")
    if not class_name:
        raise ConfigError(
            origin, f"{place!r} is not MODULE:CLASS, as in my_robot.world_class_manager:WorldClassManager"
        )
    try:
        kind = getattr(import_module(module_name), class_name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(origin, f"cannot be imported: {error}") from error
    if not (isinstance(kind, type) and issubclass(kind, Manager)):
        raise ConfigError(origin, f"{class_name} is not a macs_zenoh.managers.Manager")
    wanted = re.sub(r"(?<!^)(?=[A-Z])", "_", class_name).lower()
    if module_name.rpartition(".")[2] != wanted:
        raise ConfigError(origin, f"{class_name} must live in a module called {wanted}")
    if not (isinstance(getattr(kind, "Data", None), type) and issubclass(kind.Data, Struct)):
        raise ConfigError(origin, f"{class_name} does not say its Data, a msgspec.Struct")
    return kind()
