"""The paper's benchmark on any folder in CO3D's layout, at any scale, and what the library costs in time and memory.

    methods      the rows of the tables as plain data, groups of them, and your own
    problem      what a method is given of a pair, and what it may answer
    store cache  frames and their features, once each, in memory and on disk
    evaluation   one pair through all rows
    jobs         the unit of work: a chunk of a category's pairs
    execution    who does the jobs: this process, a pool, Dask, any `concurrent.futures.Executor`
    storage      a run's folder, safe against a kill at any moment
    run          all of these together: `evaluate`, and `plan_run`
    summary tables formats figures document compare results reports      what is made of a run

Several processes of one machine: `--workers 2`. A Dask cluster (extra `cluster`; data, backbone and the run's folder at
the same path for all, one thread per worker):

    dask scheduler                                            # says its address
    dask worker HOST:8786 --no-nanny --nthreads 1             # on every machine, once per core
    zsp-lite benchmark --executor dask://HOST:8786 ...

MPI needs nothing of ours: mpi4py has an executor.

    mpiexec -n 65 python -m mpi4py.futures -m zsp_lite benchmark --executor mpi4py.futures:MPIPoolExecutor \\
        --workers 64 --threads 1 ...

From Python, `evaluate(..., executor=executor)` takes any Executor. Results do not depend on who computes them, as long
as all processors round alike: processors of different makes may differ in a feature's last bits.
"""
