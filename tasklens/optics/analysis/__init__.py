"""Analysis of lenses by ray tracing and first-order data."""
