"""What is measured in predictions, and how certain it is."""
