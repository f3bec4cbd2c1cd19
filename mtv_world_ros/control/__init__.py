"""Controls: how a plan enters the model, one method a file."""
