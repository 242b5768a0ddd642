"""Recordings that are played.

``timeline`` reads one ahead of its time and says when each message is due, ``player`` waits for that in a thread of
its own, ``recorded`` is what a file says of its robots. ``robot`` is one of them on the mesh, ``tcp_robot`` behind a
gateway, `bridge.ros.replayed` their topics in ROS. ``commands`` plays what headsets sent: nothing else here moves a
robot.
"""
