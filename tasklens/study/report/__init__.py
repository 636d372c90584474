"""Tables, verdicts, figures and pages from measurements."""
