"""Experiments: a grid of agents, tasks, delays and seeds, worked off on one machine or a cluster, collected as rows.

```
grid.py      a TOML file becomes cells; a cell is one lockstep group of seeds, its id the hash of its configuration
folders.py   what is on disk for a cell: who holds it, what happened to it, how far it is
worker.py    one cell in a process of its own
runner.py    which cell next, retries, the time limit; `local` worker processes
slurm.py     the same on Slurm: an array job of runners with one cell each
cluster.py   the same on Ray
results.py   rows of a grid, and the table that is published
status.py    progress, speed, time left, failures
statistics.py, summary.py, figures.py, report.py   what the rows say, as Markdown and as one HTML page
cli.py       `delayrl bench`
```
"""
