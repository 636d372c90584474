"""How any job runs: files, checkpoints, devices, process groups, progress."""
