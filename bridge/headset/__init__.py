"""A headset in Python: what tests, tools and newcomers use in place of the hardware.

`bridge.headset.client` is the headset itself, `macs_zenoh.typed` reads and writes ROS messages without ROS,
`bridge.headset.script` is what ``macs headset`` runs. Nothing is imported here: the command line only wants the verbs.
"""
