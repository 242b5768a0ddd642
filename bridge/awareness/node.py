"""The gateway's ROS side: a managed node with as2_ca's service, topics and parameters.

Its callbacks run in the ROS thread and only pass things on. What they are passed to, and what arrives for modules,
belongs to the event loop; publishing is the one thing that is done here from there.
"""

from __future__ import annotations

import array
import logging
import threading
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from as2_ca_msgs.msg import InterAgentMessage, LocalGenericMessage
from as2_ca_msgs.srv import RegisterModule
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from bridge.awareness import cdr
from bridge.ros.intake import Intake
from bridge.ros.rclpy_private import change_state, lifecycle_state, on_transition
from bridge.settings import AwarenessSettings
from macs_zenoh.errors import ConfigError, UsageError
from macs_zenoh.protocol.named import check_word

log = logging.getLogger("macs.awareness")

NODE_NAME = "ca_gateway_node"
AGENTS_TOPIC = "gateway_agents"
UNDELIVERED_TOPIC = "gateway_undelivered"
RECEIVED_TOPIC = "gateway_received"
QUESTION = b"received?"
"""A message of no type with this data asks whether all is here that its sender has sent. The answer, on the topic
above, is the name that it bears in place of a receiver's."""

QOS = QoSProfile(depth=100)
"""Reliable and volatile as as2_ca's, which has depth 10: that loses all but ten messages of a burst. The depth is each
side's own and no part of what must agree."""
FROM_MODULES_QOS = QoSProfile(depth=2 * QOS.depth)
"""Room for a burst as long as modules send one, and for their questions behind it."""
SERVICE_QOS = QoSProfile(depth=1000)
"""Modules start all at once: at the default depth of 10 some of their requests would be lost silently."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

LOOK_S = 0.1
"""How often the node looks whether modules still subscribe."""

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Parameters(NamedTuple):
    """What the node's parameters say, with as2_ca's names and defaults."""

    agent_id: str
    inter_agent_topic: str
    out_messages_topic: str
    register_module_service_name: str
    transport: str


class Owner(Protocol):
    """Whom the node tells what happens; called in the ROS thread."""

    def configured(self, parameters: Parameters) -> None: ...
    def activated(self) -> None: ...
    def deactivated(self) -> None: ...
    def module_sent(self, receiver: str, message_type: str, data: bytes) -> None: ...
    def topic_received(self, sender: str, receiver: str, message_type: str, data: bytes) -> None: ...
    def types_wanted(self, types: frozenset[str]) -> None: ...


class GatewayNode(LifecycleNode):  # type: ignore[misc]  # rclpy has no types
    """Made by `RosSession`; see `macs awareness --help` for what it does."""

    def __init__(self, name: str, *, settings: AwarenessSettings, owner: Owner, **options: Any) -> None:
        # unlike other nodes of this project it has parameter services: tools set its parameters before they configure
        super().__init__(name, **{**options, "start_parameter_services": True})
        self.problem = ""
        """Why the last transition failed."""
        self._owner = owner
        self._intake = Intake(self)
        self._active = False
        self._lock = threading.Lock()
        self._modules: dict[str, Any] = {}
        self._wanted: frozenset[str] = frozenset()
        self._made: list[tuple[Any, Any]] = []
        self._inter_agent: Any = None
        self._agents: Any = None
        self._undelivered: Any = None
        self._received: Any = None
        self._diagnostics: Any = None
        self._chosen = Parameters("", "", "", "", "")
        try:
            self.declare_parameter("agent_id", settings.name)
            self.declare_parameter("inter_agent_topic", "/agent_to_agent")
            self.declare_parameter("out_messages_topic", "gateway_out")
            self.declare_parameter("register_module_service_name", "register_module")
            self.declare_parameter("transport", settings.transport)
        except ParameterException as error:
            raise ConfigError(f"parameters of {self.get_fully_qualified_name()}", str(error)) from error
        on_transition(self, self._change_state)

    def destroy_node(self) -> None:
        """End everything."""
        self._intake.close()
        super().destroy_node()

    @property
    def state(self) -> str:
        """``unconfigured``, ``inactive``, ``active`` or ``finalized``."""
        return lifecycle_state(self)

    # -- transitions ---------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters; make the service and the topics."""
        try:
            parameters = self._read_parameters()
            self._make(parameters)
        except (ConfigError, UsageError) as error:
            return self._fail(str(error))
        except Exception as error:  # noqa: BLE001 - rclpy's errors for invalid names have no common base
            return self._fail(f"ROS does not accept the parameters: {str(error).splitlines()[0]}")
        self._chosen = parameters
        self._owner.configured(parameters)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to pass messages."""
        self._active = True
        self._owner.activated()
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pass no more; registrations stay."""
        self._active = False
        self._owner.deactivated()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self._unmake()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The same, for good."""
        if self._active:
            self.on_deactivate(state)
        self._unmake()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """A transition raised: begin again from unconfigured."""
        return self.on_shutdown(state)

    def _change_state(self, request: Any, response: Any) -> Any:
        """Answer a transition that is not possible now with a refusal; rclpy raises and answers nothing."""
        try:
            return change_state(self, request, response)
        except RuntimeError as error:
            log.warning("transition %s is not possible: %s", request.transition.id, str(error).splitlines()[0])
            response.success = False
            return response

    def _fail(self, problem: str) -> TransitionCallbackReturn:
        self.problem = problem
        log.error("cannot be configured: %s", problem)
        self._unmake()
        return FAILURE

    def _read_parameters(self) -> Parameters:
        parameters = Parameters(*(self.get_parameter(name).value for name in Parameters._fields))
        check_word("the parameter agent_id", parameters.agent_id)
        if parameters.transport not in ("mesh", "topic", "both"):
            raise ConfigError("transport", f"{parameters.transport!r} is none of mesh, topic and both")
        return parameters

    def _make(self, parameters: Parameters) -> None:
        if parameters.transport != "mesh":
            self._inter_agent = self._publisher(InterAgentMessage, parameters.inter_agent_topic, QOS)
            self._subscribe(InterAgentMessage, parameters.inter_agent_topic, self._from_topic)
        self._agents = self._publisher(String, AGENTS_TOPIC, LATCHED)
        self._undelivered = self._publisher(LocalGenericMessage, UNDELIVERED_TOPIC, QOS)
        self._received = self._publisher(String, RECEIVED_TOPIC, QOS)
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics", QOS)
        from_modules = parameters.out_messages_topic, self._from_module, FROM_MODULES_QOS
        self._made.append((self._intake.unsubscribe, self._intake.subscribe(LocalGenericMessage, *from_modules)))
        timer = self.create_timer(LOOK_S, self._look)
        self._made.append((self.destroy_timer, timer))
        service = self.create_service(
            RegisterModule, parameters.register_module_service_name, self._register_module, qos_profile=SERVICE_QOS
        )
        self._made.append((self.destroy_service, service))

    def _publisher(self, kind: type[Any], topic: str, qos: QoSProfile) -> Any:
        publisher = self.create_publisher(kind, topic, qos)
        self._made.append((self.destroy_publisher, publisher))
        return publisher

    def _subscribe(self, kind: type[Any], topic: str, callback: Any) -> None:
        subscription = self.create_subscription(kind, topic, callback, QOS)
        self._made.append((self.destroy_subscription, subscription))

    def _unmake(self) -> None:
        with self._lock:
            made, self._made = self._made, []
            modules, self._modules = self._modules, {}
            self._inter_agent = self._agents = self._undelivered = self._received = self._diagnostics = None
        for destroy, entity in reversed(made):
            destroy(entity)
        for publisher in modules.values():
            self.destroy_publisher(publisher)
        self._set_wanted(frozenset())

    # -- modules -------------------------------------------------------------------------------------------------

    def _register_module(self, request: Any, response: Any) -> Any:
        """Give a module the topic of its type; an empty topic is as2_ca's way to say no."""
        publisher = self._modules.get(request.type)
        if publisher is None:
            try:
                check_word("the type", request.type)
                publisher = self.create_publisher(LocalGenericMessage, f"{request.type}_in", QOS)
            except Exception as error:  # noqa: BLE001 - rclpy's errors for invalid names have no common base
                problem = str(error).splitlines()[0]
                log.warning("module %r cannot register %r: %s", request.module_name, request.type, problem)
                response.topic = ""
                return response
            with self._lock:
                self._modules[request.type] = publisher
        response.topic = str(publisher.topic_name)
        log.info("module %r registered %r on %s", request.module_name, request.type, response.topic)
        return response

    def _look(self) -> None:
        """Which types a living module takes: registered, and subscribed."""
        taken = (name for name, publisher in self._modules.items() if publisher.get_subscription_count())
        self._set_wanted(frozenset(taken))

    def _set_wanted(self, types: frozenset[str]) -> None:
        if types != self._wanted:
            self._wanted = types
            self._owner.types_wanted(types)

    def _from_module(self, raw: bytes, _info: Mapping[str, Any]) -> None:
        try:
            message = cdr.read(raw) or deserialize_message(raw, LocalGenericMessage)
        except Exception as error:  # noqa: BLE001 - whatever rclpy raises for bytes that are none of its type
            log.warning("a message on %s cannot be read: %s", self._chosen.out_messages_topic, error)
            return
        if not message.type and bytes(message.data) == QUESTION:
            self._publish("_received", String(data=message.agent))
        elif self._active:
            self._owner.module_sent(message.agent, message.type, bytes(message.data))

    def _from_topic(self, message: Any) -> None:
        if self._active:
            self._owner.topic_received(message.sender, message.receiver, message.type, bytes(message.data))

    # -- from any thread -----------------------------------------------------------------------------------------

    def deliver(self, sender: str, message_type: str, data: bytes) -> bool:
        """Publish to the modules of a type; False when none has registered it."""
        message = cdr.write(sender, message_type, data)
        with self._lock:
            publisher = self._modules.get(message_type)
            if publisher is None:
                return False
            publisher.publish(message)
        return True

    def send_on_topic(self, sender: str, receiver: str, message_type: str, data: bytes) -> None:
        """Publish on the plain inter-agent topic."""
        message = InterAgentMessage(sender=sender, receiver=receiver, type=message_type, data=array.array("B", data))
        self._publish("_inter_agent", message)

    def say_undelivered(self, receiver: str, message_type: str, why: str) -> None:
        """Tell modules that a message to an agent was not delivered."""
        data = array.array("B", why.encode())
        self._publish("_undelivered", LocalGenericMessage(agent=receiver, type=message_type, data=data))

    def say_agents(self, agents: str) -> None:
        """Tell modules who can be reached (JSON)."""
        self._publish("_agents", String(data=agents))

    def say_counters(self, counters: dict[str, int]) -> None:
        """Put the counters where ROS tools look for them."""
        status = DiagnosticStatus(
            name=f"{self.get_fully_qualified_name()}: messages",
            message=f"{self.state}, transport {self._chosen.transport}",
            hardware_id=self._chosen.agent_id,
            values=[KeyValue(key=name, value=str(count)) for name, count in sorted(counters.items())],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._publish("_diagnostics", message)

    def _publish(self, name: str, message: Any) -> None:
        with self._lock:
            publisher = getattr(self, name)
            if publisher is not None:
                publisher.publish(message)
