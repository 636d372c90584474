"""Lenses and rankings as figures, tables and pages; columns and digits are declared in `headings.csv`."""
