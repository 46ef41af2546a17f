"""Synthetic sample data for commands outside a clone of the repository."""

import logging
from contextlib import suppress
from pathlib import Path

from zsp_lite.course.samples import sample_data
from zsp_lite.course.synthetic.export import export_preset
from zsp_lite.errors import InputError
from zsp_lite.io.files import cache_folder
from zsp_lite.io.locks import writing

logger = logging.getLogger(__name__)


def make_sample_data() -> Path:
    """Return the folder of the sample data; where there is none, make that of the preset "demo" in
    the cache, once, which takes about 15 s.

    An interrupted call is completed by the next one.
    """
    with suppress(InputError):
        return sample_data()
    made = cache_folder() / "samples"
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
