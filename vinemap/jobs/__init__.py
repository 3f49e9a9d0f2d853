"""Many parcels and many surveys: what has arrived, what needs work, and the processes or Dask workers that do it."""
