"""Manufacturing errors: built lenses, their focus in assembly, and the sensitivity to each error."""
