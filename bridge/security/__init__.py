"""Security by generation: a policy of who exists and who may what, and everything that follows from it."""
