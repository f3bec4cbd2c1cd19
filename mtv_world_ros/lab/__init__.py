"""The lab: trains, scores, imports and checks."""
