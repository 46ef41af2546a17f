"""The sample data: the folder of the repository, or, outside a clone, what the commands make in the
cache."""

from pathlib import Path

from zsp_lite.errors import InputError
from zsp_lite.io.files import REPOSITORY, cache_folder


def sample_data() -> Path:
    """Return the folder of the sample data: `data_samples/` here or in the repository, or
    `samples/` in the cache (see `make_samples`); InputError if there is none."""
    folders = (Path("data_samples"), REPOSITORY / "data_samples", cache_folder() / "samples")
    for folder in folders:
        if folder.is_dir():
            return folder
    raise InputError(
        f"no sample data in {', '.join(map(str, folders))}: expected a clone of the repository, or "
        "`zsp-lite demo` once, which makes synthetic ones"
    )
