"""Data types and pure functions on arrays: the replay, views, networks, objectives and protocols."""
