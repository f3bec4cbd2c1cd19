"""The fault kinds, a module for each family."""
