"""What a run leaves behind: trajectories, the map, metrics, logs, images; every whole file is written atomically."""
