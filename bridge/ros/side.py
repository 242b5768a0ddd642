"""The ROS side of a robot: what interface nodes need of a ROS graph, whoever speaks to it.

`session.RosSession` does it with rclpy, `bridge.rmw_zenoh.session.ZenohSession` on the keys of ROS's Zenoh middleware,
with no ROS installed. Messages, requests and goals are CDR here; what reads or writes them as objects is behind this.

All methods belong to the ROS thread (`Side.submit`), unless they say otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, NamedTuple, Protocol, TypeVar

from bridge.ros.shapes import Structure, least_cdr_bytes
from bridge.ros.stream import cdr_problem
from bridge.ros.types import InterfaceName
from bridge.ros.unity_cdr import Parts, UnityCdr
from bridge.ros.whole import Whole
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from macs_zenoh.protocol.schemas import Definition

T = TypeVar("T")

NamesAndTypes = list[tuple[str, list[str]]]

OnRaw = Callable[[bytes, Mapping[str, Any]], None]
"""Takes one message as CDR, with its ``source_timestamp`` in ns and its ``publication_sequence_number``; in a thread
that may not be kept waiting."""

REASON_FIELDS = frozenset(
    {"message", "error", "error_message", "error_msg", "error_string", "status_message", "reason"}
)
"""Text fields in which services say what went wrong, by the habits of ROS packages (std_srvs: ``message``)."""


class Other(NamedTuple):
    """Somebody's end of a topic."""

    node: str
    """Full name of its node."""
    type: str
    qos: Qos


class Found(NamedTuple):
    """What the other nodes of a graph have, each name with its type."""

    subscribers: dict[str, str]
    publishers: dict[str, str]
    services: dict[str, str]


class NotOfType(Exception):
    """Bytes that are no message of their type; the text says why."""


def first_line(error: Exception) -> str:
    """What an error says, without the places in C++ that it came through."""
    text = str(error).splitlines()
    return text[0].split(", at ")[0] if text else type(error).__name__


class MessageType:
    """A message's type, or that of one half of a service.

    Attributes:
        least_bytes: that any of its messages has, with its header.
        unity: its form for existing headsets, where that is another one.
        parts: what bounds its messages for Python, where there can be many.
    """

    def __init__(self, shape: Structure | None) -> None:
        """``shape`` None: it is not known what its messages consist of, and they are passed on as they are."""
        self.least_bytes = least_cdr_bytes(shape) if shape is not None else 4
        self.unity = UnityCdr.of(shape) if shape is not None else None
        self.parts = Parts.of(shape) if shape is not None else None
        self._whole = Whole(shape) if shape is not None else None

    def problem(self, cdr: bytes) -> str | None:
        """Why these bytes cannot be CDR of this type, as ROS writes it; None when they may be. Whoever reads them in
        ROS may end by them otherwise. From any thread."""
        problem = cdr_problem(cdr)
        return self._whole.problem(cdr) if problem is None and self._whole is not None else problem

    def filled(self, values: Mapping[str, Any], what: str) -> bytes:
        """A message with these fields, the others zero. ``what`` names the setting in errors. Raises Refused."""
        raise NotImplementedError

    def failure(self, reason: str, values: Mapping[str, Any] | None, what: str) -> bytes:
        """The response of a service that was not answered: every field zero, so ``success`` is false, and the reason
        where the type has a field for it; or what the settings say. Raises Refused."""
        raise NotImplementedError


class ServiceType(NamedTuple):
    """The two halves of a service; ``own`` is whatever the side knows it by."""

    request: MessageType
    response: MessageType
    own: Any = None


class ActionType(NamedTuple):
    """An action, as far as its goals are looked at."""

    goal: MessageType
    own: Any = None


class Events(NamedTuple):
    """What becomes of a subscription besides its messages; in the thread of its messages."""

    matched: Callable[[int, int], None] = lambda count, change: None
    """How many publishers there are now, and how many more than before."""
    incompatible: Callable[[], None] = lambda: None
    """A publisher came that offers less than the subscription asks for."""
    lost: Callable[[int], None] = lambda count: None
    """So many messages were lost on their way."""


class Closable(Protocol):
    """Something of ours on the graph."""

    def close(self) -> None:
        """End it; messages that are being taken may still come."""


class CutOff(Exception):
    """Nothing reaches the robot's nodes now, since the way to them is lost."""


class Publisher(Closable, Protocol):
    """Ours, on a topic."""

    def publish(self, cdr: bytes) -> None:
        """From any thread. Raises CutOff, and whatever the middleware does."""


class Client(Closable, Protocol):
    """Ours, of a service."""

    def is_ready(self) -> bool:
        """Whether the service is there. From any thread."""

    def call(self, request: bytes, done: Callable[[bytes | None, str], None]) -> Callable[[], None]:
        """Ask. ``done`` gets the response, or None and why there is none, in any thread. Returns what forgets the
        call. Raises NotOfType."""


class Server(Closable, Protocol):
    """Ours: a service."""

    def answer(self, header: Any, response: bytes) -> None:
        """Answer a request. Raises NotOfType, and whatever the middleware does."""


class Goals(Closable, Protocol):
    """Ours: a client of an action."""

    def is_ready(self) -> bool:
        """Whether all of the action is there. From any thread."""

    def send(self, goal_id: bytes, goal: bytes, told: GoalTold) -> None:
        """Give a goal. Raises NotOfType."""

    def cancel(self, goal_id: bytes, done: OnCancel) -> None:
        """Ask the action to cancel a goal."""


OnCancel = Callable[[int | None, bool, str], None]
"""Hears the return code of a cancellation (action_msgs/CancelGoal), whether goals are being cancelled, and why neither
can be known."""


class GoalTold(NamedTuple):
    """Who hears of a goal, in any thread."""

    accepted: Callable[[bool], None]
    fed_back: Callable[[bytes], None]
    finished: Callable[[int, bytes], None]
    """The status and the result, CDR."""
    failed: Callable[[str], None]
    """The middleware could not do it, and why."""


class Side(Protocol):
    """The ROS graph of a robot, and our node in it."""

    @property
    def domain(self) -> int:
        """The ROS domain. From any thread."""

    @property
    def beside(self) -> str:
        """What cannot be done from here for the robot's safety; empty for a program on the robot."""

    @property
    def full_name(self) -> str:
        """Namespace and name of our node. From any thread."""

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Run ``job`` in the ROS thread, after those submitted before. From any thread; never waits.

        The future raises Unreachable when the session ends first.
        """

    def hurry(self, job: Callable[[], T]) -> Future[T]:
        """The same of what must not wait for the others where that can be avoided, as it ends what moves the robot;
        perhaps in another thread. What is submitted later is done after it."""

    def later(self, delay_s: float, job: Callable[[], object]) -> None:
        """Run ``job`` in the ROS thread after a time, unless the session ends before."""

    async def run(self, job: Callable[[], T]) -> T:
        """Run ``job`` in the ROS thread and return its result or raise its error."""

    # -- names ---------------------------------------------------------------------------------------------------

    def topic_name(self, name: str) -> str:
        """A topic's full name, expanded and remapped for our node. From any thread. Raises Refused."""

    def service_name(self, name: str) -> str:
        """The same of a service."""

    # -- the graph -----------------------------------------------------------------------------------------------

    def topics(self) -> NamesAndTypes:
        """All topics of the graph."""

    def services(self) -> NamesAndTypes:
        """All services of the graph."""

    def publishers(self, topic: str) -> list[Other]:
        """Who publishes a topic, we as well."""

    def subscriptions(self, topic: str) -> list[Other]:
        """Who subscribes to a topic, we as well."""

    def count_publishers(self, topic: str) -> int:
        """How many publishers a topic has, by its full name. From any thread."""

    def count_servers(self, service: str) -> int:
        """How many nodes have a service, by its full name."""

    def servers_elsewhere(self, service: str) -> list[str]:
        """Full names of the other nodes that have this service."""

    def found(self) -> Found:
        """What the other nodes have; the first type by alphabet where a topic has several."""

    # -- types ---------------------------------------------------------------------------------------------------

    def definition(self, name: InterfaceName) -> Definition:
        """The text of a type's definition, and its hash. From any thread. Raises Refused."""

    def message(self, name: InterfaceName, topic: str = "") -> MessageType:
        """A message's type, as it is on this topic. Raises Refused: it is not known here."""

    def service(self, name: InterfaceName, topic: str = "") -> ServiceType:
        """The same of a service."""

    def action(self, name: InterfaceName, topic: str = "") -> ActionType:
        """The same of an action."""

    # -- our ends ------------------------------------------------------------------------------------------------

    def subscribe(
        self, of: MessageType, topic: str, on_raw: OnRaw, qos: Qos, events: Events | None = None
    ) -> Closable:
        """Subscribe. Raises Refused."""

    def advertise(
        self, of: MessageType, topic: str, qos: Qos, matched: Callable[[int], None] | None = None
    ) -> Publisher:
        """Publish. ``matched`` hears how many subscriptions have found it. Raises Refused."""

    def client(self, of: ServiceType, service: str) -> Client:
        """Call a service. Raises Refused."""

    def serve(self, of: ServiceType, service: str, on_request: Callable[[bytes, Any], None]) -> Server:
        """Have a service. ``on_request`` gets each request, with what its answer needs. Raises Refused."""

    def goals(self, of: ActionType, action: str) -> Goals:
        """Give goals to an action. Raises Refused."""
