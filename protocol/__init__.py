"""What learner and actors agree on: messages, their bytes, the keys, and the way they travel."""
