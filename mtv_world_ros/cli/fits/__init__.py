"""Commands that fit parameters to recordings: `mtv-world fit ...`."""
