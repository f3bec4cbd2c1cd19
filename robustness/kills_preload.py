"""Loaded by the fork server of `kills`: everything that is started, so that starting is cheap."""

from robustness import kills

kills.imported()
