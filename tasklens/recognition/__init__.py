"""Images and classifiers; knows PSFs only as tensors."""
