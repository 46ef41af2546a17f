"""Default data folders: the user's CO3D folder, or the sample data of the repository."""

import os
from pathlib import Path

DATA_VARIABLE = "ZSP_LITE_DATA"  # environment variable with the path of the user's CO3D folder
REPOSITORY = Path(__file__).resolve().parents[2]


def data_folders(data: Path | None = None) -> list[tuple[str, Path]]:
    """List the folders to search for data, in order, each with the name of its origin.

    Args:
        data: Folder of the option --data, if given.
    """
    folders = [("--data", data)] if data is not None else []
    if os.environ.get(DATA_VARIABLE):
        folders.append((DATA_VARIABLE, Path(os.environ[DATA_VARIABLE])))
    return [*folders, ("data_samples", sample_data())]


def sample_data() -> Path:
    """Return the sample data folder: `data_samples/` in the current folder, or else in the repository."""
    here = Path("data_samples")
    return here if here.is_dir() else REPOSITORY / "data_samples"
