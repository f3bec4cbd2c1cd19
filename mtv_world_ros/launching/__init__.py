"""World model, policy and episode runner as processes."""
