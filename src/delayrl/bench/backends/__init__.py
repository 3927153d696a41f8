"""Where cells run: on this machine, on Slurm, on Ray."""
