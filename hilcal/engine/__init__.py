"""Many independent computations, on this machine or on a cluster (Dask)."""
