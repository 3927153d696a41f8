"""Training: the loop, its learner and actors, and how it stops and resumes."""
