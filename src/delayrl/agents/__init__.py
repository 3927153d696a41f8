"""The agents, one file each, and the registry that lists them."""
