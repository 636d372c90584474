"""Declaration and execution of jobs."""
