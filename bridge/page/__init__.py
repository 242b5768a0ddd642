"""The live page of a gateway: files for browsers, and what they are told besides what comes over the WebSocket.

`files` has the page itself, `fresh` what is asked once for all who look, `mesh` and `robots` what is shown of the mesh
and of each robot, `definitions` the types of messages, `routes` where it all is.
"""
