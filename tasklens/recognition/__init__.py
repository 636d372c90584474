"""Images and classifiers, independent of optics: PSFs are tensors."""
