"""Infrastructure of jobs: files, checkpoints, devices, progress."""
