"""Training clips: what is cut from recordings, and its batches."""
