"""Fleet: recordings of many joints, diagnosed on Dask, stored as Parquet, and evaluated together.

`sources` finds the recordings, `diagnosing` converts one to rows, `engine` runs this on a cluster, `dataset`
stores the rows, `statistics` and `summary` evaluate them, `report` creates the page. docs/fleet.md describes
the command.
"""
