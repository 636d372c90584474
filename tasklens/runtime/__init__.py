"""Infrastructure of jobs: files, checkpoints, devices, process groups, progress."""
