"""Bytes to accepted segments, and weights back."""
