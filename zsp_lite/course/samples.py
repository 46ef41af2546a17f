"""The sample data: the folder of the repository, or, outside a clone, synthetic objects in the
cache."""

import logging
from pathlib import Path

from zsp_lite.errors import InputError
from zsp_lite.io.files import REPOSITORY, cache_folder
from zsp_lite.io.locks import writing

logger = logging.getLogger(__name__)


def sample_data() -> Path:
    """Return the folder of the sample data: `data_samples/` here or in the repository, or
    `samples/` in the cache.

    Outside a clone of the repository, synthetic objects are made once in the cache, which takes
    about 15 s (the preset "demo" of `zsp-lite synth`). An interrupted call is completed by the next
    one.
    """
    made = cache_folder() / "samples"
    for folder in (Path("data_samples"), REPOSITORY / "data_samples", made):
        if folder.is_dir():
            return folder
    from zsp_lite.course.synthetic.export import export_preset

    # A warning, because a program without logging settings shows nothing else.
    logger.warning("No data_samples/ here: making synthetic samples in %s, once", made)
    part = made.with_name(made.name + ".part")
    try:
        with writing(part):
            export_preset("demo", part)
        part.rename(made)
    except (OSError, InputError) as error:
        if not made.is_dir():  # If the folder is there, another process has made it meanwhile.
            raise InputError(
                f"samples cannot be made in {made} ({error}); set ZSP_LITE_CACHE to a folder that "
                "can be written"
            ) from error
    return made
