"""`realsim export`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER
from realsim.app.options import Has, command, options, rare
from realsim.app.outputs import GOES_ON


class Formats(click.Choice[str]):
    """A format that scenes and grasps are written in; of others, the command that writes them."""

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        """Return what is said of a format that is not among them."""
        if value == "lerobot":
            return "`realsim demonstrations SOURCE --out FOLDER` writes the grasps that were tried."
        return super().get_invalid_choice_message(value, ctx)


FORMATS = Formats((
    "bop graspnet colmap nerfstudio urdf mjcf usd graspit grasp-group acronym graspgen isaac hdf5 "
    "parquet"
).split())  # fmt: skip


@command(
    "export",
    "realsim export demo/session --to bop --out as_bop",
    "realsim export dataset --to nerfstudio --out as_nerfstudio --only-scenes 1",
)
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@options(
    to=Has(kind=FORMATS, note=f": {', '.join(FORMATS.choices)}", required=True),
    out=Has(kind=GOES_ON, note=": a folder, new or to go on in", required=True), labels="auto",
    only_scenes="", undistort=Has(False, "; BOP, GraspNet: always"), least_score=0.0, title="",
    licence="", models_licence="", attribution="",
)  # fmt: skip
@rare(
    split="", camera_name="", models=None, colour="copy", jpeg_quality=95, no_masks=False,
    colmap_points=100_000, shards=False, keep_distortion=False, table_is_world=False,
)  # fmt: skip
def export_command(
    console: Console, out: Path, no_masks: bool, camera_name: str, **options: Any
) -> None:
    """Write sessions or data sets in another format, with a card and checksums.

    SOURCE is a session, a folder of sessions (of `realsim generate` or `upgrade`), a BOP or a
    GraspNet data set. Interrupted, the same command goes on where it stopped.
    """
    from realsim.app.export.run import run_export, show_export
    from realsim.app.export.target import ExportRequest

    request = ExportRequest(masks=not no_masks, camera=camera_name, **options)
    result = run_export(request, out, console)
    show_export(result, console)
    console.result(result)
