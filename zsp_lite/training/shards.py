"""Rendered training data in files of many objects ("shards"), made in parallel and reused."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from tqdm import tqdm


def render_shards(
    render: Callable[[int], tuple[np.ndarray, ...]],
    shards: Mapping[Path, Sequence[int]],
    names: tuple[str, ...],
    workers: int = 2,
) -> None:
    """Render the shards that do not exist yet.

    Workers are started with the spawn method: a forked process would inherit locks that threads of PyTorch and OpenCV
    hold. A script that renders therefore needs the usual guard `if __name__ == "__main__":`.

    Args:
        render: Picklable function from the number of an object to its arrays.
        shards: Objects of each .npz file.
        names: Names of the arrays in the files, where the arrays of all objects are stacked.
        workers: Number of processes. With 1, and for a single shard, the current process renders.
    """
    missing = {path: objects for path, objects in shards.items() if not path.exists()}
    arguments = [(render, path, objects, names) for path, objects in missing.items()]
    if not arguments:
        return
    bar = {"desc": "rendering", "total": len(arguments), "unit": "shard", "disable": None}
    if min(workers, len(arguments)) == 1:
        for _ in tqdm(map(_render_shard, arguments), **bar):
            pass
    else:
        with ProcessPoolExecutor(min(workers, len(arguments)), get_context("spawn")) as pool:
            for _ in tqdm(pool.map(_render_shard, arguments), **bar):
                pass


def _render_shard(arguments: tuple) -> None:
    render, path, objects, names = arguments
    arrays = zip(*map(render, objects), strict=True)
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, **{name: np.stack(array) for name, array in zip(names, arrays, strict=True)})
    unfinished.rename(path)
