"""Attacks by robot programs over TCP, with what is large. Section 3."""

from __future__ import annotations

from tests.attack.inputs import MIB
from tests.attack.raw import ROS, Agent, frame, management, metadata, registration
from tests.attack.table import Target, attack

TYPE = "sensor_msgs/Image"
PER_S = 31
VIEWERS = 4


def _picture(viewers: list[Agent], robot: Agent) -> bytes:
    """One of 1 MiB, to all of them."""
    said = management("RosAgentSubscriberDataForwarder", dest_agents={"2": [viewer.id for viewer in viewers]})
    about = metadata(
        sender_agent_type=ROS, sender_agent_id=robot.id, node_type=1, node_name="nd__x", data_exchange_type=TYPE
    )
    return frame(said, about, b"\x00\x01\x00\x00" + bytes(MIB))


def _viewers(target: Target, robot: Agent, *, read: bool) -> list[Agent]:
    """Headsets of the same gateway that want it."""
    viewers = [Agent(target.port, read=read) for _ in range(VIEWERS)]
    for viewer in viewers:
        viewer.send(registration("nd__x", "/x", TYPE, agents=[robot.id], me=viewer.id))
    return viewers


@attack(3, "tcp robot")
def pictures_of_a_robot_program(target: Target) -> None:
    """A TCP robot that sends 31 pictures of 1 MiB per second to four headsets of its own gateway."""
    robot = Agent(target.port, agent_type=ROS)
    picture = _picture(_viewers(target, robot, read=True), robot)
    while target.rest(1 / PER_S):
        robot.send(picture)


@attack(3, "tcp robot")
def pictures_that_nobody_reads(target: Target) -> None:
    """The same at full rate, to headsets that have registered and do not read."""
    robot = Agent(target.port, agent_type=ROS)
    picture = _picture(_viewers(target, robot, read=False), robot)
    while target.running() and robot.send(picture):
        pass
