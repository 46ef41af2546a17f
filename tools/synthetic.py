"""Render the validation categories into a CO3D folder.

python -m tools.synthetic --sequences 5 --frames 16 --seed 11 --out outputs/validation
"""

from argparse import ArgumentParser
from pathlib import Path

from tools.validation_categories import VALIDATION
from zsp_lite.course.synthetic.export import export_categories
from zsp_lite.course.synthetic.sequences import HEIGHTS
from zsp_lite.io.locks import writing


def main(arguments: list[str] | None = None) -> None:
    """Render the sequences of all categories; an existing folder is completed."""
    parser = ArgumentParser(description=__doc__)
    for name, default in {"sequences": 4, "frames": 24, "seed": 0}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument(
        "--heights",
        type=float,
        nargs=2,
        default=HEIGHTS,
        help="range of the cameras' mean elevation",
    )
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    with writing(options.out):
        export_categories(
            list(VALIDATION),
            options.out,
            options.sequences,
            options.frames,
            options.seed,
            builders=VALIDATION,
            heights=tuple(options.heights),
        )


if __name__ == "__main__":
    main()
