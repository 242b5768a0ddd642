"""The ROS side of a robot by rclpy: `bridge.ros.side` for `session.RosSession`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import NameValidationException
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.type_support import NoTypeSupportImportedException

from bridge.ros import fields
from bridge.ros.definitions import installed_definition
from bridge.ros.intake import Intake
from bridge.ros.rclpy_private import answer_later, waiting_requests
from bridge.ros.side import (
    ActionType,
    Client,
    Closable,
    Events,
    Found,
    Goals,
    GoalTold,
    MessageType,
    NamesAndTypes,
    NotOfType,
    OnCancel,
    OnRaw,
    Other,
    Publisher,
    Server,
    ServiceType,
    first_line,
)
from bridge.ros.types import InterfaceName, resolve, shape_of
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.rmw_zenoh.qos import ENDLESS_NS, Durability, History, Liveliness, Qos, Reliability
from macs_zenoh.protocol.schemas import Definition

SERVICE_DEPTH = QoSProfile(depth=1000)
"""Of our own ends of services, so that on them nothing is lost."""
TURN = 64
"""Requests taken in one turn of the executor."""
_ENDLESS_NS = (1 << 62) - 1
"""Middlewares report "no deadline" as their own largest duration, hundreds of years."""


class RclpySide:
    """What a node of rclpy's does for interface nodes."""

    node: Node
    intake: Intake
    beside = ""
    """`Side.beside`."""

    # -- names and graph -----------------------------------------------------------------------------------------

    def topic_name(self, name: str) -> str:
        """`Side.topic_name`."""
        with ros_errors(name[:80]):
            return str(self.node.resolve_topic_name(name))

    def service_name(self, name: str) -> str:
        """`Side.service_name`."""
        with ros_errors(name[:80]):
            return str(self.node.resolve_service_name(name))

    def topics(self) -> NamesAndTypes:
        """`Side.topics`."""
        return list(self.node.get_topic_names_and_types())

    def services(self) -> NamesAndTypes:
        """`Side.services`."""
        return list(self.node.get_service_names_and_types())

    def publishers(self, topic: str) -> list[Other]:
        """`Side.publishers`."""
        return [_other(endpoint) for endpoint in self.node.get_publishers_info_by_topic(topic)]

    def subscriptions(self, topic: str) -> list[Other]:
        """`Side.subscriptions`."""
        return [_other(endpoint) for endpoint in self.node.get_subscriptions_info_by_topic(topic)]

    def count_publishers(self, topic: str) -> int:
        """`Side.count_publishers`."""
        return int(self.node.count_publishers(topic))

    def count_servers(self, service: str) -> int:
        """`Side.count_servers`."""
        return int(self.node.count_services(service))

    def servers_elsewhere(self, service: str) -> list[str]:
        """`Side.servers_elsewhere`. What has our own name is not among them: after a crash of ours ROS knows our old
        service for a while."""
        found = set()
        for name, namespace in self.node.get_node_names_and_namespaces():
            full = f"{namespace.rstrip('/')}/{name}"
            if full != self.node.get_fully_qualified_name():
                try:
                    services = self.node.get_service_names_and_types_by_node(name, namespace)
                except NodeNameNonExistentError:  # it has left meanwhile
                    continue
                if any(served == service for served, _ in services):
                    found.add(full)
        return sorted(found)

    def found(self) -> Found:
        """`Side.found`."""
        node = self.node
        own = (node.get_name(), node.get_namespace())
        others = [other for other in set(node.get_node_names_and_namespaces()) if other != own]
        return Found(
            _gather(node.get_subscriber_names_and_types_by_node, others),
            _gather(node.get_publisher_names_and_types_by_node, others),
            _gather(node.get_service_names_and_types_by_node, others),
        )

    # -- types ---------------------------------------------------------------------------------------------------

    def definition(self, name: InterfaceName) -> Definition:
        """`Side.definition`."""
        return installed_definition(name)

    def message(self, name: InterfaceName, topic: str = "") -> MessageType:
        """`Side.message`."""
        return RclpyMessage(resolve(str(name)))

    def service(self, name: InterfaceName, topic: str = "") -> ServiceType:
        """`Side.service`."""
        kind = resolve(str(name), "srv")
        return ServiceType(RclpyMessage(kind.Request), RclpyMessage(kind.Response), kind)

    def action(self, name: InterfaceName, topic: str = "") -> ActionType:
        """`Side.action`."""
        kind = resolve(str(name), "action")
        return ActionType(RclpyMessage(kind.Goal), kind)

    # -- our ends ------------------------------------------------------------------------------------------------

    def subscribe(
        self, of: MessageType, topic: str, on_raw: OnRaw, qos: Qos, events: Events | None = None
    ) -> Closable:
        """`Side.subscribe`."""
        assert isinstance(of, RclpyMessage)
        profile, kind, subscribe = rclpy_profile(qos), of.kind, self.intake.subscribe
        with ros_errors(topic):
            if events is None:
                return _Subscription(self, subscribe(kind, topic, on_raw, profile))
            try:
                return _Subscription(self, subscribe(kind, topic, on_raw, profile, events=_callbacks(events)))
            except UnsupportedEventTypeError:  # of some middlewares
                return _Subscription(self, subscribe(kind, topic, on_raw, profile))

    def advertise(
        self, of: MessageType, topic: str, qos: Qos, matched: Callable[[int], None] | None = None
    ) -> Publisher:
        """`Side.advertise`. Some middlewares do not tell who has found it."""
        assert isinstance(of, RclpyMessage)
        profile = rclpy_profile(qos)
        with ros_errors(topic):
            if matched is None:
                return _Publisher(self, self.node.create_publisher(of.kind, topic, profile))
            events = PublisherEventCallbacks(
                matched=lambda status: matched(status.current_count), use_default_callbacks=False
            )
            try:
                return _Publisher(self, self.node.create_publisher(of.kind, topic, profile, event_callbacks=events))
            except UnsupportedEventTypeError:
                return _Publisher(self, self.node.create_publisher(of.kind, topic, profile))

    def client(self, of: ServiceType, service: str) -> Client:
        """`Side.client`."""
        with ros_errors(service):
            return _Client(self, of.own, self.node.create_client(of.own, service, qos_profile=SERVICE_DEPTH))

    def serve(self, of: ServiceType, service: str, on_request: Callable[[bytes, Any], None]) -> Server:
        """`Side.serve`."""
        with ros_errors(service):
            made = self.node.create_service(
                of.own, service, lambda request, response: request, qos_profile=SERVICE_DEPTH
            )
        return _Server(self, of.own, made, on_request)

    def goals(self, of: ActionType, action: str) -> Goals:
        """`Side.goals`."""
        # 12 MB, of which robots without actions need nothing
        from rclpy.action import ActionClient

        with ros_errors(action):
            return _Goals(of.own, ActionClient(self.node, of.own, action))


class RclpyMessage(MessageType):
    """A message class of an installed interface."""

    def __init__(self, kind: type[Any]) -> None:
        super().__init__(shape_of(kind))
        self.kind = kind

    def filled(self, values: Mapping[str, Any], what: str) -> bytes:
        return bytes(serialize_message(fields.filled(self.kind, values, what)))

    def failure(self, reason: str, values: Mapping[str, Any] | None, what: str) -> bytes:
        return bytes(serialize_message(fields.failure(self.kind, reason, values, what)))


class _Subscription:
    def __init__(self, side: RclpySide, made: Any) -> None:
        self._side = side
        self._made = made

    def close(self) -> None:
        self._side.intake.unsubscribe(self._made)


class _Publisher:
    def __init__(self, side: RclpySide, made: Any) -> None:
        self._side = side
        self._made = made
        self.publish: Callable[[bytes], None] = made.publish

    def close(self) -> None:
        self._side.node.destroy_publisher(self._made)


class _Client:
    def __init__(self, side: RclpySide, kind: Any, made: Any) -> None:
        self._side = side
        self._kind = kind
        self._made = made

    def is_ready(self) -> bool:
        return bool(self._made.service_is_ready())

    def call(self, request: bytes, done: Callable[[bytes | None, str], None]) -> Callable[[], None]:
        try:
            sent = self._made.call_async(deserialize_message(request, self._kind.Request))
        except Exception as error:  # rclpy's, whatever it is
            raise NotOfType(first_line(error)) from error

        def answered(future: Any) -> None:
            try:
                response = bytes(serialize_message(future.result()))
            except Exception as error:  # noqa: BLE001 - rclpy's, whatever it is
                done(None, first_line(error))
            else:
                done(response, "")

        sent.add_done_callback(answered)
        return lambda: self._made.remove_pending_request(sent)

    def close(self) -> None:
        self._side.node.destroy_client(self._made)


class _Server:
    """A request is passed on and answered later (`rclpy_private.answer_later`)."""

    def __init__(self, side: RclpySide, kind: Any, made: Any, on_request: Callable[[bytes, Any], None]) -> None:
        self._side = side
        self._kind = kind
        self._made = made
        self._on_request = on_request
        self._respond = answer_later(made, self._take)

    def _take(self, request: Any, header: Any) -> None:
        self._on_request(bytes(serialize_message(request)), header)
        for request, header in waiting_requests(self._made, self._kind.Request, TURN):
            self._on_request(bytes(serialize_message(request)), header)

    def answer(self, header: Any, response: bytes) -> None:
        try:
            message = deserialize_message(response, self._kind.Response)
        except Exception as error:  # rclpy's, whatever it is
            raise NotOfType(first_line(error)) from error
        self._respond(message, header)

    def close(self) -> None:
        self._side.node.destroy_service(self._made)


class _Goals:
    def __init__(self, kind: Any, made: Any) -> None:
        self._kind = kind
        self._made = made
        self._handles: dict[bytes, Any] = {}

    def is_ready(self) -> bool:
        return bool(self._made.server_is_ready())

    def send(self, goal_id: bytes, goal: bytes, told: GoalTold) -> None:
        try:
            message = deserialize_message(goal, self._kind.Goal)
        except Exception as error:  # rclpy's, whatever it is
            raise NotOfType(first_line(error)) from error

        def outcome(future: Any) -> Any:
            try:
                return future.result()
            except Exception as error:  # noqa: BLE001 - rclpy's, whatever it is
                self._handles.pop(goal_id, None)
                told.failed(first_line(error))
                return None

        def accepted(future: Any) -> None:
            handle = outcome(future)
            if handle is not None:
                if handle.accepted:
                    self._handles[goal_id] = handle
                told.accepted(bool(handle.accepted))
                if handle.accepted:
                    handle.get_result_async().add_done_callback(finished)

        def finished(future: Any) -> None:
            response = outcome(future)
            if response is not None:
                self._handles.pop(goal_id, None)
                told.finished(int(response.status), bytes(serialize_message(response.result)))

        uuid = self._kind.Impl.SendGoalService.Request().goal_id
        uuid.uuid = list(goal_id)
        self._made.send_goal_async(
            message, lambda feedback: told.fed_back(bytes(serialize_message(feedback.feedback))), uuid
        ).add_done_callback(accepted)

    def cancel(self, goal_id: bytes, done: OnCancel) -> None:
        handle = self._handles.get(goal_id)
        if handle is None:
            done(None, False, "the goal has finished")
            return

        def cancelling(future: Any) -> None:
            try:
                response = future.result()
                done(int(response.return_code), bool(response.goals_canceling), "")
            except Exception as error:  # noqa: BLE001 - rclpy's, whatever it is
                done(None, False, first_line(error))

        handle.cancel_goal_async().add_done_callback(cancelling)

    def close(self) -> None:
        self._made.destroy()


class ros_errors:  # noqa: N801 - reads like the context manager that it is
    """Turns rclpy's errors about a topic into a refusal that a person understands."""

    def __init__(self, topic: str) -> None:
        self._topic = topic

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, RuntimeError | NameValidationException | NoTypeSupportImportedException):
            # rcl adds "at /path/in/its/sources" and a second line that points at the letter
            problem = str(error).splitlines()[0].split(", at ")[0]
            raise Refused(f"{self._topic!r} cannot be used on this robot: {problem}") from error


def rclpy_profile(qos: Qos) -> QoSProfile:
    """A profile as rclpy has it."""
    profile = QoSProfile(
        history=HistoryPolicy(qos.history),
        depth=qos.depth,
        reliability=ReliabilityPolicy(qos.reliability),
        durability=DurabilityPolicy(qos.durability),
        liveliness=LivelinessPolicy(qos.liveliness),
    )
    if qos.deadline_ns < _ENDLESS_NS:
        profile.deadline = Duration(nanoseconds=qos.deadline_ns)
    if qos.lifespan_ns < _ENDLESS_NS:
        profile.lifespan = Duration(nanoseconds=qos.lifespan_ns)
    if qos.lease_ns < _ENDLESS_NS:
        profile.liveliness_lease_duration = Duration(nanoseconds=qos.lease_ns)
    return profile


def qos_of(profile: QoSProfile) -> Qos:
    """A profile of rclpy's. What a middleware does not know of others counts as what it has by itself."""
    keep_all, best_effort = profile.history == HistoryPolicy.KEEP_ALL, ReliabilityPolicy.BEST_EFFORT
    latched, manual = DurabilityPolicy.TRANSIENT_LOCAL, LivelinessPolicy.MANUAL_BY_TOPIC
    return Qos(
        reliability=Reliability.BEST_EFFORT if profile.reliability == best_effort else Reliability.RELIABLE,
        durability=Durability.TRANSIENT_LOCAL if profile.durability == latched else Durability.VOLATILE,
        history=History.KEEP_ALL if keep_all else History.KEEP_LAST,
        depth=profile.depth,
        liveliness=Liveliness.MANUAL_BY_TOPIC if profile.liveliness == manual else Liveliness.AUTOMATIC,
        deadline_ns=_ns(profile.deadline),
        lifespan_ns=_ns(profile.lifespan),
        lease_ns=_ns(profile.liveliness_lease_duration),
    )


def _ns(duration: Duration) -> int:
    """0 and endless mean: no such policy."""
    return int(duration.nanoseconds) if 0 < duration.nanoseconds < _ENDLESS_NS else ENDLESS_NS


def _other(endpoint: Any) -> Other:
    node = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
    return Other(node, endpoint.topic_type, qos_of(endpoint.qos_profile))


def _gather(ask: Callable[[str, str], NamesAndTypes], nodes: Iterable[tuple[str, str]]) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, namespace in nodes:
        try:
            entries = ask(name, namespace)
        except NodeNameNonExistentError:  # it left between the two questions
            continue
        for topic, types in entries:
            if types:
                found[topic] = min(types)
    return found


def _callbacks(events: Events) -> SubscriptionEventCallbacks:
    return SubscriptionEventCallbacks(
        matched=lambda change: events.matched(change.current_count, change.current_count_change),
        incompatible_qos=lambda _change: events.incompatible(),
        message_lost=lambda status: events.lost(int(status.total_count_change)),
        use_default_callbacks=False,
    )
