"""The engine of object motion: contact scene, inputs of the drives, sampled futures."""
