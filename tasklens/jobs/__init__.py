"""Functions of the jobs of a study, from typed settings and files to files; the rules in `workflow` call them."""
