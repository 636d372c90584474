"""Task-driven lens design: the gradient of a classifier's loss passes through captures, PSFs and rays to the lens."""
