"""How a checkpoint is served: options, what they change, what they need of a device."""
