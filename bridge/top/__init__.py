"""A mesh as it is now, and what changes on it: for people at a terminal."""
