"""The scripted expert and its faults."""
