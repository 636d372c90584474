"""Restoration of captures before classification."""
