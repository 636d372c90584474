"""Dispersion of optical materials, and their files."""
