"""Lens files: YAML and Zemax."""
