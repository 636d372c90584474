"""Lens design: starts, limits, criteria, descents, least squares; `single.designs` designs one lens."""
