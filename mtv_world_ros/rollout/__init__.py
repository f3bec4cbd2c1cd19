"""The product: pipeline, rollouts of imagined episodes, offline replay."""
