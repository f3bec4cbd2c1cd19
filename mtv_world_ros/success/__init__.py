"""Relations, tasks, evidence and the success estimate."""
