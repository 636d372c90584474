"""Dispersion of optical materials, and files of them."""
