"""Policies that live in imagination, or in the simulator: one interface, clients of servers."""
