"""The acting side: environments, the suggester that plays them, and the way to the learner."""
