"""The scripted expert and its way points."""
