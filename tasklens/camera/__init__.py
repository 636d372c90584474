"""Captures of a whole sensor with PSFs that vary over the field."""
