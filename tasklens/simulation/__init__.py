"""Captures of a whole sensor, through PSFs that change over the field."""
