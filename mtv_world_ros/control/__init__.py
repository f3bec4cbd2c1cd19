"""Controls: methods by which a plan enters the model, one file each."""
