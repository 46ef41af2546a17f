"""The command `demo`: a photographed motorcycle and one pair of every category."""

import click

from zsp_lite.choices import SOLVERS
from zsp_lite.cli.common import PATH, backbone_options, examples

SYNTHETIC_NOTE = (
    "synthetic objects, composed of primitives, with depth holes and soft masks as in CO3D."
)
MODELS_NOTE = "renderings of 3D models, with depth holes and soft masks as in CO3D."
USER_NOTE = "the given folder in CO3D's layout."


@click.command(
    epilog=examples("demo", "demo --data path/to/co3d --backbone dino_vits8 --out outputs/co3d")
)
@click.option("--data", type=PATH, show_default="data_samples", help="Folder in CO3D's layout.")
@backbone_options
@click.option("--out", type=PATH, default="outputs/demo", help="Folder for the report.")
def demo(data, backbone, out) -> None:
    """Estimate poses of a real motorcycle and of sample objects.

    One pair of each category is estimated, and a report with pictures is written. The real
    motorcycle is a photograph; its targets are a category `motorcycle` of synthetic
    objects in the data.
    """
    from rich.console import Console

    from zsp_lite.backbones.named import as_backbone
    from zsp_lite.cli.terminal import print_rows
    from zsp_lite.course.demo import demo_pairs
    from zsp_lite.course.make_samples import make_sample_data
    from zsp_lite.course.photograph import photograph_section, run_photograph
    from zsp_lite.course.synthetic.export import RENDERED_FILE, SETTINGS_FILE
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.io.locks import writing
    from zsp_lite.pipeline import ZeroShotPose
    from zsp_lite.scans.pair_result import run_pair
    from zsp_lite.viz.report import write_report
    from zsp_lite.viz.table import COLUMNS, legend, table_rows

    folder = data or make_sample_data()
    notes = {SETTINGS_FILE: SYNTHETIC_NOTE, RENDERED_FILE: MODELS_NOTE}
    note = next((text for file, text in notes.items() if (folder / file).is_file()), USER_NOTE)
    with writing(out), Console().status("estimating poses"):
        dataset = Co3D(folder)
        model = as_backbone(backbone)
        name = getattr(model, "name", str(backbone))
        found = list(run_photograph(dataset, model))
        photograph = photograph_section(found) if found else None
        method = ZeroShotPose(model)
        results = [run_pair(dataset, pair, method, SOLVERS["both"]) for pair in demo_pairs(dataset)]
        report = out / "report.html"
        path = write_report(report, results, name, str(folder), note, photograph)
    if photograph:
        title = (
            f"Photographed motorcycle: directions from the rendered {photograph.sequence}, "
            "compared by eye"
        )
        print_rows(title, photograph.columns, photograph.rows, texts=2)
    rows = [row for result in results for row in table_rows(result)]
    print_rows(f"One pair per category in {folder}, backbone {name}", COLUMNS, rows, texts=2)
    print(legend(), f"Data: {note}", f"Report with pictures of every stage: {path}", sep="\n")
