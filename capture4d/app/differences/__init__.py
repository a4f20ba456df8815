"""What differs between two work folders: their settings, their metrics, and their frames one by one."""
