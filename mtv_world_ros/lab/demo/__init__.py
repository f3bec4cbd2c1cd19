"""The demo: an episode through the real node over the middleware, scored and shown."""
