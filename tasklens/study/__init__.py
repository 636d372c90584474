"""Study files: settings, checks before the first job, and the contents of tables and claims."""
