"""Where data is looked for: the sample data of the repository, or the user's own CO3D folder."""

import os
from pathlib import Path

DATA_VARIABLE = "ZSP_LITE_DATA"  # environment variable that names the user's own CO3D folder
REPOSITORY = Path(__file__).resolve().parents[2]


def data_folders(data: Path | None = None) -> list[tuple[str, Path]]:
    """Where data is looked for, first match first: (how it was named, folder)."""
    folders = [("--data", data)] if data is not None else []
    if os.environ.get(DATA_VARIABLE):
        folders.append((DATA_VARIABLE, Path(os.environ[DATA_VARIABLE])))
    return [*folders, ("data_samples", sample_data())]


def sample_data() -> Path:
    """The sample data: `data_samples/` of the current folder, or else of the repository that the package is in."""
    here = Path("data_samples")
    return here if here.is_dir() else REPOSITORY / "data_samples"
