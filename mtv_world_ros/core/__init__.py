"""Types, errors, configuration, bounded files and processes that all rooms share."""
