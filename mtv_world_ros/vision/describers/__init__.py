"""Names the objects of a scene: from the instruction, a list or a vision-language model."""
