"""Topics, services and actions of robots, for people at a command line: over the mesh, without a gateway."""
