"""The node `policy`."""
