"""What flows through training, and pure functions on it: types, replay, views, networks, objectives."""
