"""`realsim generate`: tabletop scenes out of a pool of objects, with every label."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from realsim.app.console import Console
from realsim.app.option_values import Amount
from realsim.app.options import Has, Where, command, many, options, rare
from realsim.app.outputs import GOES_ON

if TYPE_CHECKING:
    from realsim.app.generate.request import GenerateRequest


@command(
    "generate",
    "realsim generate scenes --scenes 1 --views 2 --objects 3-4 --size 320x240 --no-maps",
    "realsim generate near --scenes 1 --views 2 --objects 2 --size 320x240 --range d405",
)
@click.argument("out", type=GOES_ON)
@options(
    scenes=10, views=Has(256, " of each scene"), objects=Has("10-20", kind=Amount(1, 1000, "A-B")),
    size="1920x1080", pool=("pybullet",), range="far", depth="disparity", renderer="embedded",
    sensor=Has(None, "  [d435; d405 in its range]"), seed=0,
)  # fmt: skip
@many(note="; scenes at a time")
@rare(
    object_sizes="0.02-0.20", keep_size=False, unit=Has(None, ", with --keep-size"),
    hull_only=False, table=Has((), "  [all ten]"), radius=Has(None, ", instead of --range"),
    depth_model=None, hdris=None, textures=None, no_maps=False,
)  # fmt: skip
def generate_command(
    console: Console, out: Path, scenes: int, where: Where, **options: Any
) -> bool:
    """Make tabletop scenes in OUT: objects dropped by physics, rendered, with every label.

    Each scene is a session (OUT/scene_000000, ...) that annotate, school, review and report open;
    its poses are exact. The same seed gives the same images and labels; scene 7 does not depend on
    the others. Run again to go on after an interruption, or with more --scenes to add some.

    Writes OUT/dataset.json, OUT/contact_sheet.png and OUT/index.html, too.

    Exit codes: 0 done, 1 a scene could not be made, 2 bad input.
    """
    from realsim.app.generate import tables
    from realsim.app.generate.page import PAGE_FILE, SHEET_FILE, write_page, write_sheet
    from realsim.app.generate.run import generate
    from realsim.app.stages import note
    from realsim.store.atomic import storing, write_json

    request = _request(**options)
    if options["pools"] and not options["keep_size"]:
        console.warn(
            f"the objects get random sizes of {options['object_sizes']} m, also where that is not "
            "their own; --keep-size --unit mm keeps those of meshes in millimetres"
        )
    outcome = generate(out, scenes, request, where, console)
    layouts = tables.finished_layouts(out, scenes, request)
    sheet, page = out / SHEET_FILE, out / PAGE_FILE
    dataset = (
        tables.kept_dataset(out, request, layouts) if page.is_file() and not outcome.made else None
    )
    if dataset is None:
        dataset = tables.dataset_of(out, request, layouts)
        with storing(out, "the data set's tables and pictures"):
            sheet = write_sheet(out, layouts, request.views.count)
            page = write_page(
                out, layouts, request.views.count, tables.tables_of(out, dataset),
                tables.summary_of(dataset), tables.notes_of(dataset, outcome),
            )  # fmt: skip
            write_json(out / tables.DATASET_FILE, dataset)
    note(out, "generate", console, request={"scenes": scenes}, config=request.told)
    tables.show(out, dataset, outcome, console)
    if sheet is not None:
        console.say(f"pictures  {sheet}")
        console.say(f"page      {page}")
    told = {"made": [c.number for c in outcome.made], "kept": outcome.kept}
    console.result(dataset | {"out": out, "page": page, "failed": outcome.failed} | told)
    return not outcome.failed


def _request(**options: Any) -> "GenerateRequest":
    """Return what the options ask for.

    Raises:
        InputError: one cannot be used; it is named.
    """
    from realsim.app.generate import request
    from realsim_sim_bridge.synthetic.config import SyntheticConfig
    from realsim_sim_bridge.table_scenes.cameras import ViewConfig
    from realsim_sim_bridge.table_scenes.config import PoolConfig, TableSceneConfig
    from realsim_sim_bridge.table_scenes.pool import open_pool
    from realsim_sim_bridge.table_scenes.scene import own_looks

    near = options["distance"] == "d405" and options["radius"] is None
    rendering = SyntheticConfig(
        renderer=options["renderer"],
        depth=options["depth"],
        profile=options["sensor"] or ("d405" if near else "d435"),
        depth_model=request.depth_model_of(options["depth_model"], options["depth"]),
    )
    return request.GenerateRequest(
        pool=open_pool(options["pools"]),
        seed=options["seed"],
        scene=TableSceneConfig(
            objects=request.counts_of("--objects", str(options["objects"])),
            sizes=request.range_of("--object-sizes", options["object_sizes"], "0.02-0.2"),
            tables=options["tables"],
            pool=PoolConfig(
                keep_size=options["keep_size"], unit=options["unit"], hull_only=options["hull_only"]
            ),
        ),
        views=ViewConfig(
            count=options["views"],
            radius_m=request.radius_of(options["distance"], options["radius"]),
            size=request.size_of(options["size"]),
        ),
        rendering=replace(rendering, maps=()) if options["no_maps"] else rendering,
        looks=own_looks(options["hdris"], options["textures"]),
    )
