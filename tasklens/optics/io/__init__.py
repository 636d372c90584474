"""Reading and writing of lens files: YAML and Zemax."""
