"""The paper's benchmark on any folder in CO3D's layout, on one processor or many machines.

    run          `evaluate`, which runs the benchmark, and `plan_run`
    methods      rows of the tables, as data; groups of rows; your own
    problem      what a row is given for a pair, and what it may return
    store cache  frames and their features, in memory and on disk
    evaluation   all rows on one pair
    execution    chunks of pairs in this process, a pool, Dask, or any `concurrent.futures.Executor`
    database     a run's folder
    summary tables formats figures document compare results reports      what is made of a run
    plan         what a run would take

docs/scale.md shows how to run it on several processes and machines, with Dask or MPI.
"""
