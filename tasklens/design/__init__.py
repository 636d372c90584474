"""Lens design: starts, limits, criteria, descents, least squares; `single.design_lens` designs one lens."""
