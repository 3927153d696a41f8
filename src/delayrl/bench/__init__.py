"""Experiments: run a grid of agents, tasks, delays and seeds, and collect its rows.

```
grid.py       expands a TOML file into cells, the lockstep groups of seeds that are trained
folders.py    what is stored of a cell: its lock, its journal, its newest step
worker.py     trains one cell in a process of its own
runner.py     which cell starts next, what is tried again, when to stop
backends/     where cells run: worker processes here, Ray actors, or an array job on Slurm
status.py     progress, speed, time left and failures
results.py    rows of a grid, and the SQLite table that is published
```
"""
