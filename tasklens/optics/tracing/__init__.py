"""Rays through surfaces."""
