"""The fleet: recordings of many joints, diagnosed on Dask, stored as Parquet, and evaluated together.

`sources` finds the recordings, `diagnosing` turns one into rows, `engine` runs that on a cluster, `dataset`
stores the rows, `statistics` and `summary` evaluate them, `report` makes the page. docs/fleet.md describes
the command.
"""
