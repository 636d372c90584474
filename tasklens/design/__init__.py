"""Methods of lens design, the only package that uses both optics and networks."""
