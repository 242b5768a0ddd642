"""What is known and decided without any input or output: bytes, keys, messages, who may do what, how much of it.

Pure: nothing here opens a socket or asks a clock; times and bytes are passed in, what follows from them goes out.
"""
