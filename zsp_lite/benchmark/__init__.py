"""The paper's benchmark on any folder in CO3D's layout, on one processor or many machines.

    run          `evaluate`, which runs the benchmark
    methods own  rows of the tables, as data; groups of rows; rows of one's own
    problem      argument and results of a row
    store        frames and their features
    evaluation   all rows on one pair
    execution    chunks of pairs in this process, a pool, Dask, or any `concurrent.futures.Executor`
    runs         folder of a run, a line for each pair; a run that was read
    summary      figures of a run; statistics tables figures compare: what else is made of it

docs/scale.md shows how to run it on several processes and machines, with Dask or MPI.
"""
