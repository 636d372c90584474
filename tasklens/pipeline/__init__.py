"""Every job declared once, and how it is run."""
