"""Ways for a lens to come about; the only room where optics meets a network."""
