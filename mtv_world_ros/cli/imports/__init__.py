"""Commands that import recordings and weights: `mtv-world import ...`."""
