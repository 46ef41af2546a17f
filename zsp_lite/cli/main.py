"""The command `zsp-lite`: it parses options, calls the library and prints the results.

Each command imports what it needs inside its function, so that `--help` stays quick.
"""

import io
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from zsp_lite.choices import SOLVERS
from zsp_lite.cli.benchmark import benchmark, compare, tables
from zsp_lite.cli.common import (
    COUNT,
    PATH,
    backbone_config,
    backbone_options,
    examples,
    out_option,
    seed_option,
)
from zsp_lite.cli.data import data
from zsp_lite.cli.download import download as data_download
from zsp_lite.cli.estimate import estimate
from zsp_lite.errors import InputError

SYNTHETIC_NOTE = (
    "synthetic objects, composed of primitives by zsp_lite.synthetic and rendered with depth holes and soft masks "
    "as in CO3D."
)
MODELS_NOTE = "renderings of 3D models, with depth holes and soft masks as in CO3D."
USER_NOTE = "the given folder in CO3D's layout."
DIRECTIONS = ("+x", "-x", "+y", "-y", "+z", "-z")


@click.group(
    no_args_is_help=False,
    subcommand_metavar="COMMAND ...",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120, "show_default": True},
    epilog="`zsp-lite COMMAND --help` explains a command. Bad input: one line on stderr and exit code 2.",
)
def cli() -> None:
    """Zero-shot category-level object pose estimation: demo, benchmark, data, backbones."""


for command in (estimate, benchmark, tables, compare, data):
    cli.add_command(command)
data.add_command(data_download)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments after the program's name; those of the process where it is None.

    Returns:
        Exit code: 0, 1 (a check failed), 2 (bad input or wrong usage), or 130 (interrupted).
    """
    logging.basicConfig(format="%(message)s")
    logging.getLogger("zsp_lite").setLevel(logging.INFO)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # notebooks and tests have others
            stream.reconfigure(errors="backslashreplace")  # names of files need not be valid text
    try:
        with cli.make_context("zsp-lite", list(sys.argv[1:] if argv is None else argv)) as context:
            return cli.invoke(context) or 0
    except click.exceptions.Exit as stop:  # --help
        return stop.exit_code
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "zsp-lite"
        message = f"{error.format_message()} (see: {command} --help)"
    except InputError as error:
        message = str(error)
    except OSError as error:  # a folder without write permission, a full disk
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except KeyboardInterrupt:
        print("zsp-lite: interrupted", file=sys.stderr)
        return 130
    print(f"zsp-lite: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


@cli.command(
    epilog=examples(
        "demo",
        "demo --data path/to/co3d --backbone dino_vits8 --out outputs/co3d",
        "demo --layer last --facet token --out outputs/tokens",
        "demo --solver paper",
    )
)
@click.option("--data", type=PATH, metavar="DIR", show_default="data_samples", help="Folder in CO3D's layout.")
@click.option(
    "--solver", type=click.Choice(SOLVERS), default="both",
    help="The paper's solver, the verified solver, or both, for the pairs of the categories.",
)  # fmt: skip
@backbone_options
@out_option("outputs/demo", "Folder for the report.")
def demo(data: Path | None, solver: str, out: Path, **backbone) -> None:
    """Estimate the pose of a real motorcycle and of one pair per category: tables, and a report with pictures.

    The real motorcycle is a photograph; its targets are a category `motorcycle` of synthetic objects in the data.
    """
    import matplotlib

    matplotlib.use("Agg")  # figures are written to files, without a display
    from rich.console import Console
    from rich.table import Table

    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.samples import sample_data
    from zsp_lite.demo import run_demo, run_photograph
    from zsp_lite.io.locks import writing
    from zsp_lite.synthetic.export import SETTINGS_FILE
    from zsp_lite.synthetic.model_export import RENDERED_FILE
    from zsp_lite.viz.photograph import PHOTOGRAPH_COLUMNS, photograph_rows
    from zsp_lite.viz.report import COLUMNS, legend, table_rows, write_overview, write_report

    console = Console(markup=False)  # names may hold brackets
    folder = data or sample_data()
    notes = {SETTINGS_FILE: SYNTHETIC_NOTE, RENDERED_FILE: MODELS_NOTE}
    note = next((text for file, text in notes.items() if (folder / file).is_file()), USER_NOTE)
    with writing(out):
        dataset, model = Co3D(folder), load_backbone(backbone_config(**backbone))
        name = getattr(model, "name", backbone["backbone"])
        with console.status("estimating the pose of the photographed motorcycle"):
            photograph = list(run_photograph(dataset, model))
        with console.status("estimating"):
            results = list(run_demo(dataset, model, SOLVERS[solver]))
        with console.status("writing the report"):
            path = write_report(out / "report.html", results, str(folder), note, name, photograph)
            write_overview(out / "overview.jpg", results)
    if photograph:
        table = Table(
            title=f"Photographed motorcycle: directions from the rendered {photograph[0].sequence}, compared by eye"
        )
        for column in PHOTOGRAPH_COLUMNS:
            table.add_column(column, justify="left" if column in PHOTOGRAPH_COLUMNS[:2] else "right")
        for row in photograph_rows(photograph):
            table.add_row(*row)
        console.print(table)
    table = Table(title=f"One pair per category in {folder}, backbone {name}")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column in COLUMNS[:2] else "right")
    for result in results:
        for row in table_rows(result):
            table.add_row(*row)
    console.print(table)
    console.print(legend(), highlight=False)
    console.print(f"Data: {note}", highlight=False)
    console.print(f"Report with pictures of every stage: {path}", soft_wrap=True)


@cli.command(
    epilog=examples(
        "synth --preset demo --out outputs/demo-data",
        "synth --preset paper --out outputs/paper",
        "synth --category chair --category car --sequences 2 --seed 7 --out outputs/mine",
        "synth --category validation --sequences 8 --frames 16 --seed 5 --out outputs/validation",
        "synth --models path/to/models --image-size 320 --out outputs/models",
        "synth --models path/to/models --front -x --up +z --out outputs/models",
    )
)
@click.option(
    "--preset", metavar="NAME",
    help="Procedural objects: demo (3 categories, 15 s), samples (4), eval (10), paper-small (20 of 5 sequences of 24 "
    "frames), or paper (20 of 10 sequences of 100 frames, 1.5 hours, 1.4 GB). An existing folder is completed.",
)  # fmt: skip
@click.option(
    "--category", "categories", multiple=True, metavar="NAME",
    help="A category, or a whole split: training, validation or evaluation. May be repeated.",
)  # fmt: skip
@click.option(
    "--models", "models_folder", type=PATH, metavar="FOLDER",
    help="Your own textured meshes, CATEGORY/NAME.EXT with EXT one of obj, glb, gltf, ply, stl, dae: a sequence each.",
)  # fmt: skip
@click.option(
    "--front", type=click.Choice(DIRECTIONS), show_default="+z; -y for stl",
    help="With --models: the front of the models, as an axis of their files. models.json overrides it.",
)  # fmt: skip
@click.option(
    "--up", type=click.Choice(DIRECTIONS), show_default="+y; +z for stl",
    help="With --models: the top of the models, likewise.",
)  # fmt: skip
@click.option("--sequences", type=COUNT, metavar="N", show_default="4", help="With --category: sequences per category.")
@click.option(
    "--frames", type=COUNT, metavar="N", show_default="24", help="With --category or --models: frames per sequence."
)
@click.option(
    "--image-size", type=click.IntRange(min=32), metavar="PX", show_default="256",
    help="With --models: shorter image side in pixels.",
)  # fmt: skip
@seed_option
@click.option("--out", type=PATH, metavar="DIR", required=True, help="Folder to write.")
def synth(
    preset: str | None, categories: tuple[str, ...], models_folder: Path | None, front: str | None, up: str | None,
    sequences: int | None, frames: int | None, image_size: int | None, seed: int, out: Path,
) -> None:  # fmt: skip
    """Render procedural objects or your own models into a CO3D folder; the same seed gives the same files."""
    if bool(preset) + bool(categories) + bool(models_folder) != 1:
        raise click.UsageError("expected either --preset or --category or --models")
    if image_size and not models_folder:
        raise InputError("--image-size goes with --models; --preset and --category fix the size of the images")
    if (front or up) and not models_folder:
        raise InputError("--front and --up go with --models")
    from tqdm import tqdm

    from zsp_lite.io.locks import writing
    from zsp_lite.synthetic.export import export_categories, export_preset

    if models_folder:
        if sequences:
            raise InputError("--sequences goes with --category; --models makes one sequence per model")
        from zsp_lite.synthetic.model_export import export_models

        with writing(out):
            left_out = export_models(models_folder, out, frames or 24, seed, image_size or 256, front, up, tqdm)
        for key, reason in left_out.items():
            print(f"Left out {key}: {reason}")
    elif preset:
        if sequences or frames:
            raise InputError("a preset fixes its sequences and frames; --sequences and --frames go with --category")
        with writing(out):
            export_preset(preset, out, seed, progress=tqdm)
    else:
        with writing(out):
            export_categories(list(categories), out, sequences or 4, frames or 24, seed, progress=tqdm)
    print(f"Written: {out}")


@cli.group(
    no_args_is_help=False,
    subcommand_metavar="ACTION ...",
    epilog=examples("weights list", "weights fetch dino_vits8", "weights verify path/to/checkpoint.pth"),
)
def weights() -> None:
    """List, download or verify the weights of backbones."""


@weights.command("list", epilog=examples("weights list"))
def list_weights() -> None:
    """List every backbone with its file, or where to get it."""
    from zsp_lite.backbones.pretrained import available_backbones, obtained_by

    for name, path in available_backbones().items():
        print(f"{name:19} {path or obtained_by(name)}")


@weights.command(epilog=examples("weights fetch dino_vits8", "weights fetch hf:facebook/dinov2-small"))
@click.argument("name")
def fetch(name: str) -> None:
    """Download a backbone: NAME as `weights list` prints it, or hf:NAME."""
    from zsp_lite.backbones.pretrained import download

    print(f"Available: {download(name)}")


@weights.command(epilog=examples("weights verify dino_vits8", "weights verify path/to/checkpoint.pth"))
@click.argument("name")
def verify(name: str) -> None:
    """Check that weights are complete and load: NAME as `weights list` prints it, hf:NAME, or a checkpoint file."""
    from zsp_lite.backbones import load

    load.verify(name)
    print(f"{name}: complete, loads")


@cli.command(epilog=examples("doctor", "doctor --data path/to/co3d"))
@click.option("--data", type=PATH, metavar="DIR", help="Also check this CO3D folder.")
def doctor(data: Path | None) -> int:
    """Check Python, PyTorch, the weights, the cache and the data, and print a fix for every problem."""
    from zsp_lite.cli.doctor import BAD, run_checks

    failed = []
    for check in run_checks(data):
        print(f"{check.state:4}  {check.name:22}  {check.found}")
        if check.fix:
            print(f"{'':4}  {'':22}  -> {check.fix}")
        if check.state == BAD:
            failed.append(check.name)
    print(f"Missing or broken: {', '.join(failed)}." if failed else "Everything required is installed.")
    return 1 if failed else 0
