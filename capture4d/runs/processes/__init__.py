"""Jobs in processes of this machine, behind `run_jobs`."""
