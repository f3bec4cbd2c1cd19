"""How arms follow, and numbers of contact, fitted to recorded episodes."""
