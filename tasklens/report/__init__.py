"""Tables, verdicts, figures and pages from what was measured."""
