"""How a plan enters the model: the trajectory video and what it draws."""
