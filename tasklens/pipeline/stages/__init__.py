"""Functions of the stages, with settings, inputs and outputs as arguments."""
