"""Arms in the physics: bodies, inertia, collision parts, response to commands."""
