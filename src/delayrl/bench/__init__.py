"""Experiments: run a grid of agents, tasks, delays and seeds, and collect its rows."""
