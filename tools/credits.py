"""Write the credits of the works that the shipped weights were trained on: zsp_lite/weights/ATTRIBUTION.md.

    python tools/credits.py

The works are those of `training.json` and `backgrounds.json`.
"""

import textwrap
from pathlib import Path

from zsp_lite.io.files import write_atomic

try:
    from tools import backgrounds
    from tools.models import LICENCES, Source, read_catalogue
except ModuleNotFoundError:  # run as a script
    import backgrounds
    from models import LICENCES, Source, read_catalogue

TOOLS = Path(__file__).parent
PAGE = TOOLS.parent / "zsp_lite" / "weights" / "ATTRIBUTION.md"
_INTRODUCTION = """\
# Attribution

`zsp-tiny.safetensors` and `zsp-tiny-photo.safetensors` were trained on renders of the 3D models below, many of them in
front of parts of the pictures below. None of these works is part of this package. For the training, the models were
deformed, recoloured, scaled and rendered, and the pictures were cropped and resized. The authors do not endorse the
weights. Works without a title have the name of their file or a description.
"""


def page() -> str:
    """Return the page in Markdown: the works by licence and author."""
    models, pictures = read_catalogue(TOOLS / "training.json"), backgrounds.read_catalogue()
    works = {name: entry for group in models.models.values() for name, entry in group.items()}
    return (
        "\n".join(
            [
                _INTRODUCTION,
                *_section("3D models", models.packages, works),
                *_section("Pictures", pictures.packages, pictures.pictures),
            ]
        ).rstrip("\n")
        + "\n"
    )


def _section(heading: str, packages: dict[str, str], works: dict[str, Source]) -> list[str]:
    sources = ", ".join(f"{name} {version}" for name, version in packages.items())
    lines = [f"## {heading}", "", *_wrapped(f"From {sources}."), ""]
    groups: dict[tuple[str, str], list[str]] = {}
    for name, work in works.items():
        groups.setdefault((work.licence, work.author), []).append(work.title or name.replace("_", " "))
    for licence in sorted({licence for licence, _ in groups}):
        lines += [f"### {licence}", "", f"<{LICENCES[licence]}>", ""]
        for author in sorted((author for one, author in groups if one == licence), key=str.lower):
            titles = ", ".join(dict.fromkeys(groups[licence, author]))  # each once
            lines += _wrapped(f"- **{author}**: {titles}", "  ")
        lines.append("")
    return lines


def _wrapped(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(text, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


if __name__ == "__main__":
    write_atomic(PAGE, page().encode())
