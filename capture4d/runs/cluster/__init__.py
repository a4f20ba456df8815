"""Jobs on a Dask cluster, behind `run_jobs`."""
