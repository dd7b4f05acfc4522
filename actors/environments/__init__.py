"""Gymnasium's room: a user's environment is made, stepped and read here, and its faults named."""
