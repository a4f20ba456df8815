"""What has been done in a work folder, what is stale and why, and what a run would do."""
