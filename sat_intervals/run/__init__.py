"""Plan, submit and match tiles of one or many pairs, and assemble the files. Only this folder imports dask."""
