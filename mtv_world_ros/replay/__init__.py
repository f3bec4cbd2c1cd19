"""Recorded episodes replayed through the model without ROS: MCAP to MCAP."""
