"""The demo: an episode through the node, scored and shown."""
