"""Pages, tables and charts of evaluations and rankings."""
