"""Robots that run ROS 2's own Zenoh middleware, on the mesh without anything installed on them: `macs rmw-zenoh`.

``session`` is the ROS side of such a robot (`bridge.ros.side`), without ROS; ``types`` is what is known of its types.
``robots`` says who is there, ``program`` has them join the mesh: with the interface nodes, safety and rules of
`bridge.ros`.
"""
