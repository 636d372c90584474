"""Images, the networks that read them, and their training and measurement on captures."""
