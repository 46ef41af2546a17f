"""Build the folder of models of the evaluation preset `artists` from unpacked Debian packages.

    apt-get download sweethome3d-furniture flightgear-data-ai
    for file in *.deb; do dpkg-deb -x $file packages/${file%%_*}; done
    python tools/artists.py packages outputs/artists_models
    zsp-lite synth --models outputs/artists_models --out outputs/artists

`tools/artists.json` names every model: package, file, licence, author and orientation. The models themselves are not
part of this repository. Those under GPL may be rendered for evaluation only; neither they nor pictures of them are
to be published.
"""

import hashlib
import shutil
import sys
import zipfile
from pathlib import Path

import msgspec

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_bytes, write_atomic
from zsp_lite.synthetic.models import MODELS_FILE, ModelInfo

try:
    from tools.ac3d import convert
except ModuleNotFoundError:  # run as a script
    from ac3d import convert

CATALOGUE = Path(__file__).with_name("artists.json")


class Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One model of the catalogue.

    Attributes:
        package: Debian package.
        file: File in the package.
        sha256: Checksum of the model's own file (that of the archive member where `member` is given).
        licence: Licence of the model.
        author: Author of the model.
        licence_file: Where the licence was read: in the package, or in the archive beside the model.
        member: Path of the model in the archive `file`.
        textures: Folder of the package with textures that are not beside the model.
        front: Front in the axes of the file; the top is +y.
    """

    package: str
    file: str
    sha256: str
    licence: str
    author: str
    licence_file: str
    member: str = ""
    textures: str = ""
    front: str = "+z"


class Catalogue(msgspec.Struct, frozen=True):
    """The content of `artists.json`: versions of the packages, and the models by category and name."""

    packages: dict[str, str]
    models: dict[str, dict[str, Entry]]


def read_catalogue(path: Path = CATALOGUE) -> Catalogue:
    """Return the catalogue. Raises InputError if it is damaged."""
    return decode(read_bytes(path, "catalogue"), Catalogue, path)


def build(packages: Path, out: Path, catalogue: Catalogue) -> None:
    """Copy or convert every model of the catalogue to `out/CATEGORY/NAME/` and write `out/models.json`.

    Args:
        packages: Folder with one folder per unpacked package.
        out: Folder to write.
        catalogue: The models.

    Raises:
        InputError: If a package or a file is missing, or a file is another one than that of the catalogue.
    """
    infos = {}
    for category, models in catalogue.models.items():
        for name, entry in models.items():
            target = out / plain_name(category, "category") / plain_name(name, "model")
            source = packages / entry.package / entry.file
            if not source.is_file():
                raise InputError(
                    f"{category}/{name}: {source} is missing, expected the unpacked package {entry.package}"
                )
            if target.is_dir():
                shutil.rmtree(target)
            if entry.member:
                _extract(source, entry, target, name)
            else:
                _check(entry, source.read_bytes(), source)
                folders = [packages / entry.package / entry.textures] if entry.textures else []
                convert(source, target / f"{name}.obj", folders)
            origin = f"{entry.package} {catalogue.packages[entry.package]}: {entry.member or entry.file}"
            changes = "" if entry.member else "converted from AC3D"
            infos[f"{category}/{name}"] = ModelInfo(entry.front, "+y", entry.author, entry.licence, origin, changes)
    write_atomic(out / MODELS_FILE, msgspec.json.format(msgspec.json.encode(infos), indent=1))


def _extract(archive: Path, entry: Entry, target: Path, name: str) -> None:
    """Extract an OBJ file of an archive, as NAME.obj, with the files beside it."""
    folder = entry.member.rpartition("/")[0] + "/"
    target.mkdir(parents=True)
    with zipfile.ZipFile(archive) as files:
        if entry.member not in files.namelist():
            raise InputError(f"{archive} has no {entry.member}")
        _check(entry, files.read(entry.member), archive)
        for member in files.namelist():
            rest = member.removeprefix(folder)
            if member.startswith(folder) and rest and "/" not in rest:
                written = f"{name}.obj" if member == entry.member else rest
                (target / written).write_bytes(files.read(member))


def _check(entry: Entry, data: bytes, where: Path) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != entry.sha256:
        raise InputError(f"{where} {entry.member}: checksum {found}, expected {entry.sha256} as in the catalogue")


if __name__ == "__main__":
    try:
        build(Path(sys.argv[1]), Path(sys.argv[2]), read_catalogue())
    except (InputError, IndexError) as error:
        sys.exit(__doc__ if isinstance(error, IndexError) else str(error))
