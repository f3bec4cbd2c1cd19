"""How objects move under commanded tools: a graph network over objects and grippers."""
