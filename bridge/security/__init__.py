"""Security by generation: a plan of who exists and who may what, and everything that follows from it."""
