"""What a run is: its condition, configuration, folder, checkpoints, and what it was made with."""
