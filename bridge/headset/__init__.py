"""A headset in Python: what tests, tools and newcomers use in place of the hardware.

`client` is the headset itself, `typed` reads and writes ROS messages without ROS, `script` is what
``macs headset`` runs. Importing `client` needs neither ROS nor rosbags.
"""

from .client import Headset, Link
from .nodes import Incoming, Node, Publisher, Service, ServiceRequest, Subscription

__all__ = ["Headset", "Incoming", "Link", "Node", "Publisher", "Service", "ServiceRequest", "Subscription"]
