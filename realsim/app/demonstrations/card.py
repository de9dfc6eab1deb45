"""The card of a data set of demonstrations."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from realsim.app.export.card import DatasetCard, SceneFacts, card_bytes
from realsim.formats.labelled_scene import WrittenScene

if TYPE_CHECKING:
    from realsim.app.demonstrations.run import DemonstrationRequest

LOADING = """
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/demonstrations", root="FOLDER")
step = dataset[0]  # observation.state, observation.images.front, action, task, ...
"""
STATED = ("name", "licence", "models_licence", "attribution")
"""Options that the card tells elsewhere."""


def demonstrations_card(
    request: "DemonstrationRequest",
    written: WrittenScene,
    names: dict[int, str],
    successes: int,
    out: Path,
) -> bytes:
    """Return the card as Markdown.

    Args:
        request: what was asked for.
        written: what came of it.
        names: of the objects, by id.
        successes: attempts that passed all stages.
        out: the data set's folder.
    """
    from realsim_sim_bridge.demonstrations.lerobot_episodes import CONVENTIONS

    facts = SceneFacts(
        written=replace(
            written, folder=Path(), counts={**written.counts, "successful episodes": successes}
        ),
        labels="replayed in simulation by realsim: physics of the hand, rendered pictures",
        instances=len(names),
        grasps_tried=written.counts["episodes"],
        grasps_good=successes,
    )
    plain = type(request)()
    options = [
        (name.replace("_", "-"), str(value))
        for name, value in asdict(request).items()
        if value != getattr(plain, name) and name not in STATED
    ]
    return card_bytes(
        DatasetCard(
            name=request.name or out.resolve().name,
            format="LeRobot",
            conventions=[("version", "LeRobot v3.0"), ("steps per second", str(request.fps)),
                         *CONVENTIONS],
            scenes=[facts],
            objects=names,
            loading=LOADING,
            command=[("command", "realsim demonstrations"), *options],
            sources=[written.name],
            licence=request.licence,
            models_licence=request.models_licence,
            attribution=request.attribution,
        )
    )  # fmt: skip
