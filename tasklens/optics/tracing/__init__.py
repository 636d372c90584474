"""Differentiable ray tracing through the surfaces of a lens."""
