"""MuJoCo's batches of rollouts."""

from typing import Any

Rollout: Any
