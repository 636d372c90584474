"""Job functions of a study: typed settings and input files to output files. The rules in `workflow` call them."""
