"""Training clips: cutting them from recordings, and batches of them."""
