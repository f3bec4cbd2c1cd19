"""What can be wrong with a scripted policy: the catalogue, and what carries it out."""
