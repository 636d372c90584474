"""Restoration of captures before the classifier sees them."""
