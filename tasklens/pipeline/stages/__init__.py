"""The work of each stage, as a function of settings, inputs and outputs."""
