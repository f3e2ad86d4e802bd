"""Many tiles, many pairs: plan, submit, match, assemble. The only home of dask."""
