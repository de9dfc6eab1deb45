"""`realsim generate`: tabletop scenes out of a pool of objects, with every label."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, many, seed
from realsim.app.outputs import GOES_ON

if TYPE_CHECKING:
    from realsim.app.generate.request import GenerateRequest
    from realsim.many import PoolConfig


@click.command(
    "generate",
    cls=Command,
    examples=(
        "realsim generate scenes --scenes 1 --views 2 --objects 3-4 --size 320x240 --no-maps",
        "realsim generate near --scenes 1 --views 2 --objects 2 --size 320x240 --range d405",
    ),
)
@click.argument("out", type=GOES_ON)
@click.option("--scenes", default=10, show_default=True, type=click.IntRange(1, 1_000_000),
              help="So many in all.")  # fmt: skip
@seed("The same seed, the same scenes.")
@click.option("--views", default=256, show_default=True, type=click.IntRange(1, 100_000),
              help="Of each scene.")  # fmt: skip
@click.option("--size", default="1920x1080", show_default=True, metavar="WxH", help="Of images.")
@click.option("--pool", "pools", multiple=True, default=("pybullet",), show_default=True,
              metavar="POOL[=WEIGHT]",
              help="pybullet, a folder of meshes, or a model library; repeat.")  # fmt: skip
@click.option("--objects", default="10-20", show_default=True, help="Of each scene.")
@click.option("--object-sizes", default="0.02-0.20", show_default=True,
              help="Largest extent, as a share of the table's longer side.")  # fmt: skip
@click.option("--keep-size", is_flag=True, help="Objects keep their own size.")
@click.option("--unit", type=click.Choice(("m", "cm", "mm", "inch")), default=None,
              help="Of mesh files, with --keep-size.")  # fmt: skip
@click.option("--hull-only", is_flag=True,
              help="Meshes collide as their hulls: quicker, no hollows.")  # fmt: skip
@click.option("--table", "tables", multiple=True, metavar="NAME",
              help="Only these table models; repeat.  [all ten]")  # fmt: skip
@click.option("--range", "distance", default="far", show_default=True,
              type=click.Choice(("far", "d405")), help="1 to 2 m, or 0.25 to 0.5 m.")  # fmt: skip
@click.option("--radius", default=None, metavar="A-B", help="Distance of cameras [m], instead.")
@click.option("--renderer", default="embedded", show_default=True,
              type=click.Choice(("embedded", "photoreal")),
              help="Rasterised here, or ray-traced by Mitsuba.")  # fmt: skip
@click.option("--depth", default="disparity", show_default=True,
              type=click.Choice(("stereo", "disparity", "clean")),
              help="Simulated sensor.")  # fmt: skip
@click.option("--profile", default=None, metavar="NAME",
              help="Depth camera: d405, d415, d435, structured_light.  [d435; d405 in its range]"
              )  # fmt: skip
@click.option("--depth-model", type=FOLDER, default=None, metavar="FILE",
              help="Of `realsim depth-fit`: noise and holes as your own camera's.")  # fmt: skip
@click.option("--hdris", type=FOLDER, default=None, help="Folder of own panoramas (.hdr, .exr).")
@click.option("--textures", type=FOLDER, default=None,
              help="Folder of own textures: pictures, or a folder for each material.")  # fmt: skip
@click.option("--no-maps", is_flag=True, help="No label maps (coordinates, normals, ...).")
@many(help="Scenes at a time.")
@JSON
@QUIET
def generate_command(
    out: Path, scenes: int, where: "PoolConfig", as_json: bool, quiet: bool, **options: Any
) -> None:
    """Make tabletop scenes in OUT: objects dropped by physics, rendered, with every label.

    Each scene is a session (OUT/scene_000000, ...) that annotate, school, review and report open;
    its poses are exact. The same seed gives the same images and labels; scene 7 does not depend on
    the others. Run again to go on after an interruption, or with more --scenes to add some.

    Writes OUT/dataset.json, OUT/contact_sheet.png and OUT/index.html, too.

    Exit codes: 0 done, 1 a scene could not be made, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.generate.page import write_page, write_sheet
    from realsim.app.generate.run import generate
    from realsim.app.generate.tables import (
        dataset_of,
        finished_layouts,
        notes_of,
        show,
        summary_of,
        tables_of,
        write_dataset,
    )
    from realsim.app.stages import note
    from realsim.store.atomic import storing

    request = _request(**options)
    console = Console(quiet=quiet, as_json=as_json)
    outcome = generate(out, scenes, request, where, console)
    layouts = finished_layouts(out, scenes, request)
    dataset = dataset_of(out, request, layouts)
    with storing(out, "the data set's tables and pictures"):
        write_dataset(out, dataset)
        sheet = write_sheet(out, layouts, request.views.count)
        page = write_page(
            out, layouts, request.views.count, tables_of(out, dataset), summary_of(dataset),
            notes_of(dataset, outcome),
        )  # fmt: skip
    note(out, "generate", console, request={"scenes": scenes}, config=request.told)
    show(out, dataset, outcome, console)
    if sheet is not None:
        console.say(f"pictures  {sheet}")
        console.say(f"page      {page}")
    told = {"made": [c.number for c in outcome.made], "kept": outcome.kept}
    console.result(dataset | {"out": out, "page": page, "failed": outcome.failed} | told)
    if outcome.failed:
        sys.exit(1)


def _request(**options: Any) -> "GenerateRequest":
    """Return what the options ask for.

    Raises:
        InputError: one cannot be used; it is named.
    """
    from realsim.app.generate.request import (
        GenerateRequest,
        counts_of,
        depth_model_of,
        radius_of,
        range_of,
        size_of,
    )
    from realsim_sim_bridge.synthetic.config import SyntheticConfig
    from realsim_sim_bridge.table_scenes.cameras import ViewConfig
    from realsim_sim_bridge.table_scenes.config import PoolConfig, TableSceneConfig
    from realsim_sim_bridge.table_scenes.pool import open_pool
    from realsim_sim_bridge.table_scenes.scene import own_looks

    near = options["distance"] == "d405" and options["radius"] is None
    rendering = SyntheticConfig(
        renderer=options["renderer"],
        depth=options["depth"],
        profile=options["profile"] or ("d405" if near else "d435"),
        depth_model=depth_model_of(options["depth_model"], options["depth"]),
    )
    return GenerateRequest(
        pool=open_pool(options["pools"]),
        seed=options["seed"],
        scene=TableSceneConfig(
            objects=counts_of("--objects", options["objects"]),
            sizes=range_of("--object-sizes", options["object_sizes"], "0.02-0.2"),
            tables=options["tables"],
            pool=PoolConfig(
                keep_size=options["keep_size"],
                unit=options["unit"],
                hull_only=options["hull_only"],
            ),
        ),
        views=ViewConfig(
            count=options["views"],
            radius_m=radius_of(options["distance"], options["radius"]),
            size=size_of(options["size"]),
        ),
        rendering=replace(rendering, maps=()) if options["no_maps"] else rendering,
        looks=own_looks(options["hdris"], options["textures"]),
    )
