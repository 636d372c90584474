"""Design lenses for a task: a classifier's loss flows through captures, PSFs and rays into a lens."""
