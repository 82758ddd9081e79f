"""The fleet: recordings of many joints, diagnosed on Dask, kept as Parquet, and read as a whole.

`sources` finds the recordings, `diagnosing` makes rows of one, `engine` runs that on a cluster, `dataset`
keeps the rows, `statistics` and `summary` read them, `report` draws the page. docs/fleet.md describes the
command.
"""
