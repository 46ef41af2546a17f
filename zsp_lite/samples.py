"""The sample data: those of the repository, or, outside a clone, synthetic objects that are made once in the cache.

`zsp-lite doctor` imports this module, also where a package is missing: packages are imported by the functions.
"""

import logging
import os
from pathlib import Path

from zsp_lite.errors import InputError

logger = logging.getLogger(__name__)

DATA_VARIABLE = "ZSP_LITE_DATA"  # environment variable with the path of the user's CO3D folder
REPOSITORY = Path(__file__).resolve().parents[1]


def default_data() -> Path:
    """Return the data folder that the environment variable ZSP_LITE_DATA names, else that of the sample data."""
    return Path(os.environ[DATA_VARIABLE]) if os.environ.get(DATA_VARIABLE) else sample_data()


def find_sample_data() -> Path:
    """Return `data_samples/` here or in the repository, else `samples/` in the cache, which may not exist."""
    from zsp_lite.io.download import cache_folder

    folders = Path("data_samples"), REPOSITORY / "data_samples"
    return next((folder for folder in folders if folder.is_dir()), cache_folder() / "samples")


def sample_data() -> Path:
    """Return the folder of the sample data.

    Outside a clone of the repository, synthetic objects are made once in the cache, which takes about 15 s (the preset
    "demo" of `zsp-lite synth`). An interrupted call is completed by the next one.
    """
    folder = find_sample_data()
    if folder.is_dir():
        return folder
    from zsp_lite.io.locks import writing
    from zsp_lite.synthetic.export import export_preset

    # A warning, because a program without logging settings shows nothing else.
    logger.warning("No data_samples/ here: making synthetic samples in %s, once", folder)
    part = folder.with_name(folder.name + ".part")
    try:
        with writing(part):
            export_preset("demo", part)
        part.rename(folder)
    except (OSError, InputError) as error:
        if folder.is_dir():  # another process has made them meanwhile
            return folder
        raise InputError(
            f"samples cannot be made in {folder} ({error}); set ZSP_LITE_CACHE to a folder that can be written, or "
            f"{DATA_VARIABLE} to a data folder"
        ) from error
    return folder
