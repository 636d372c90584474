"""Methods of lens design; the only room where optics meets a network."""
