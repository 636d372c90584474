"""Captures: images blurred by PSFs, noise and quantisation of a sensor, and a whole sensor whose PSFs vary."""
