"""A second physics engine as another ground truth."""
