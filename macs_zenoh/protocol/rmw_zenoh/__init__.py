"""What ROS 2's Zenoh middleware (rmw_zenoh) puts on a Zenoh network: keys, tokens, QoS, attachments, type hashes.

Measured against rmw_zenoh_cpp 0.2.10 (Jazzy); docs/rmw-zenoh.md says more. Pure: nothing here opens a session.
"""
