"""Tasks: how they are named and made, the papers' nine, and small probes."""
