"""The command `synth`: renderings of procedural objects or of the user's models."""

import click

from zsp_lite.cli.common import INDEX, PATH, examples, refuse_options

DIRECTIONS = ("+x", "-x", "+y", "-y", "+z", "-z")


@click.command(
    epilog=examples(
        "synth --preset demo --out outputs/demo-data",
        "synth --category chair --category car --sequences 2 --frames 16 --out outputs/mine",
        "synth --models path/to/models --image-size 320 --out outputs/models",
    )
)
@click.option("--preset", metavar="NAME", help="Procedural objects in one of the sizes above.")
@click.option(
    "--category", "categories", multiple=True, metavar="NAME", help="A category; may be repeated."
)
@click.option(
    "--models", "models_folder", type=PATH, help="Folder of your own textured meshes, see above."
)
@click.option(
    "--front",
    type=click.Choice(DIRECTIONS),
    show_default="+z; -y for stl",
    help="Front of the models.",
)
@click.option(
    "--up", type=click.Choice(DIRECTIONS), show_default="+y; +z for stl", help="Top of the models."
)
@click.option(
    "--sequences", type=click.IntRange(1, 900), show_default="4", help="Sequences of each category."
)
@click.option(
    "--frames", type=click.IntRange(1, 10_000), show_default="24", help="Frames of each sequence."
)
@click.option(
    "--image-size",
    type=click.IntRange(32, 4096),
    show_default="256",
    help="Shorter image side in pixels.",
)
@click.option("--seed", type=INDEX, default=0, help="Seed of every random draw.")
@click.option("--out", type=PATH, required=True, help="Folder to write.")
def synth(preset, categories, models_folder, seed, out, **given) -> None:
    """Render procedural objects or your own models. They are written as a CO3D folder; the same
    seed gives the same objects and cameras.

    \b
    --preset    demo (3 categories, 15 s), paper-small (20 of 5 sequences of 24 frames), or paper
                (20 of 10 sequences of 100 frames, 1.5 hours, 1.4 GB)
    --category  one of the paper's twenty categories; may be repeated
    --models    files CATEGORY/NAME.EXT with EXT one of obj, glb, gltf, ply, stl, dae: a sequence
                each; --front and --up are axes of these files, and models.json overrides them

    An existing folder is completed.
    """
    if bool(preset) + bool(categories) + bool(models_folder) != 1:
        raise click.UsageError("expected either --preset or --category or --models")
    from zsp_lite.course.synthetic.export import export_categories, export_models, export_preset
    from zsp_lite.io.locks import writing

    chosen = {name: value for name, value in given.items() if value is not None}
    left_out = {}
    with writing(out):
        if preset:
            refuse_options(chosen, (), "--preset")
            export_preset(preset, out, seed)
        elif categories:
            refuse_options(chosen, ("sequences", "frames"), "--category")
            sizes = {"sequences": 4, "frames": 24} | chosen  # the defaults of the help text
            export_categories(list(categories), out, seed=seed, **sizes)
        else:
            refuse_options(chosen, ("frames", "image_size", "front", "up"), "--models")
            left_out = export_models(models_folder, out, seed=seed, **chosen)
    for key, reason in left_out.items():
        print(f"Left out {key}: {reason}")
    print(f"Written: {out}")
