"""Settings of lenses, cameras, networks and designs: frozen, typed, with units, limits and defaults; no torch here."""
