"""The paper's benchmark on any folder in CO3D's layout, on one processor or many machines.

    run          `evaluate`, which runs the benchmark
    methods      rows of the tables, as data; groups of rows; user-defined rows
    problem      argument and results of a row
    store cache  frames and their features, in memory and on disk
    evaluation   all rows on one pair
    execution    chunks of pairs in this process, a pool, Dask, or any `concurrent.futures.Executor`
    records      folder of a run: a line for each pair
    results      a run that was read; summary statistics tables figures compare: what is made of it

docs/scale.md shows how to run it on several processes and machines, with Dask or MPI.
"""
