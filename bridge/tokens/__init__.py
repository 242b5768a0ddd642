"""The file in which the hashes and rights of tokens are kept: written by `macs token`, followed by gateways."""
