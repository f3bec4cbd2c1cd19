"""Training of the object motion network from recorded episodes."""
