"""The protocol as named checks that anybody's program can be held to (docs/conformance.md).

`vectors` reads the bytes that come with the package, `checks` says what a check is and keeps what became of each,
`report` writes that down, `client_frames` judges what a headset says: all pure. `agents` and `router` are the ends of
connections, `gateway` and `headset` what is tried over them.
"""
