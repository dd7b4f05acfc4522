"""The networks, their gradients written out, and Adam: pure."""
