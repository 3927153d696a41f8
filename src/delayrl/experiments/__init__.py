"""Experiments: from a grid to tables, and a report of them."""
