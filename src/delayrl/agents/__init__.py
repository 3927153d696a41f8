"""The agents, one file each; the registry names them."""
