"""What `realsim generate` was asked for, and the folder that belongs to it."""

import hashlib
import json
import math
import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from realsim import __version__
from realsim.errors import InputError
from realsim.many import Sent
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.store import atomic, provenance
from realsim.untrusted.own_json import read_object
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.table_scenes.cameras import RANGES, ViewConfig
from realsim_sim_bridge.table_scenes.config import TableSceneConfig
from realsim_sim_bridge.table_scenes.pool import PYBULLET, ObjectPool, pybullet_folder
from realsim_sim_bridge.table_scenes.scene import OwnLooks

REQUEST_FILE = "generate.json"
LAYOUTS = "layouts"
"""Folder of the scenes' layouts and of the notes that they are finished."""
FORMAT = 1
RESULTS_VERSION = 3
"""Raised whenever the same request gives other scenes."""


Files = tuple[tuple[Path | None, ...], tuple[Path, ...], tuple[Path, ...]]
"""What a request reads: see `GenerateRequest.with_files`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GenerateRequest:
    """What every scene of a data set depends on, besides its number."""

    pool: ObjectPool
    seed: int = 0
    scene: TableSceneConfig = field(default_factory=TableSceneConfig)
    views: ViewConfig = field(default_factory=ViewConfig)
    rendering: SyntheticConfig = field(default_factory=lambda: SyntheticConfig(profile="d435"))
    looks: OwnLooks = field(default_factory=OwnLooks)

    @property
    def told(self) -> dict[str, Any]:
        """Plain JSON values by which two requests are told apart; views may be added to."""
        values: dict[str, Any] = json.loads(json.dumps({
            "seed": self.seed,
            "scene": asdict(self.scene),
            "views": asdict(self.views),
            "rendering": asdict(self.rendering),
            "pool": [{"label": s.label, "weight": s.weight, "objects": len(s.keys),
                      "digest": s.digest} for s in self.pool.sources],
            "own_looks": _looks_digest(self.looks),
        }))  # fmt: skip
        return values

    def files(self) -> tuple[Any, ...]:
        """Return the files as they travel to another machine, where they are `Files`."""
        folders = (None if s.kind == PYBULLET else Sent(s.folder) for s in self.pool.sources)
        looks = (tuple(map(Sent, self.looks.hdris)), tuple(map(Sent, self.looks.textures)))
        return tuple(folders), *looks

    def with_files(
        self, folders: tuple[Path | None, ...], hdris: tuple[Path, ...], textures: tuple[Path, ...]
    ) -> "GenerateRequest":
        """Return the request with its files in other places.

        Args:
            folders: of the pool's sources; None = where PyBullet is installed here.
            hdris: the user's panoramas.
            textures: the user's textures.
        """
        moved = zip(self.pool.sources, folders, strict=True)
        sources = tuple(replace(s, folder=f or pybullet_folder()) for s, f in moved)
        looks = OwnLooks(hdris=hdris, textures=textures)
        return replace(self, pool=ObjectPool(sources=sources), looks=looks)

    @property
    def key(self) -> str:
        """A digest of it."""
        text = json.dumps([RESULTS_VERSION, self.told], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _looks_digest(looks: OwnLooks) -> str:
    if not looks.hdris and not looks.textures:
        return ""
    digest = hashlib.sha256()
    images = [
        p
        for path in looks.textures
        for p in (sorted(path.iterdir()) if path.is_dir() else [path])
        if p.is_file()
    ]
    for path in (*looks.hdris, *images):
        digest.update(f"{path.name} {path.stat().st_size}\n".encode())
    return digest.hexdigest()[:16]


def size_of(text: str) -> tuple[int, int]:
    """Return width and height of 'WIDTHxHEIGHT' [px].

    Raises:
        InputError: it is no such text.
    """
    width, mark, height = text.lower().partition("x")
    if not mark or not width.strip().isdecimal() or not height.strip().isdecimal():
        raise InputError(f"--size '{text}' is no image size; WIDTHxHEIGHT is, such as 1280x720.")
    return int(width), int(height)


def range_of(option: str, text: str, example: str) -> tuple[float, float]:
    """Return the ends of 'A-B', or twice A of 'A'.

    Raises:
        InputError: it is no such text.
    """
    low, mark, high = text.partition("-")
    try:
        ends = float(low), float(high if mark else low)
    except ValueError:
        ends = math.nan, math.nan
    if not all(math.isfinite(end) for end in ends):
        raise InputError(f"{option} '{text}' is no range; LEAST-MOST is, such as {example}.")
    return ends


def counts_of(option: str, text: str) -> tuple[int, int]:
    """Return least and greatest number of 'A-B', or twice A of 'A'.

    Raises:
        InputError: it is no such text.
    """
    few, many = range_of(option, text, "10-20")
    if few != int(few) or many != int(many):
        raise InputError(f"{option} '{text}': whole numbers are accepted, such as 10-20.")
    return int(few), int(many)


def depth_model_of(path: Path | None, depth: str) -> DepthSensorModel | None:
    """Return the fitted camera of `--depth-model`; None = the profile's figures.

    Raises:
        InputError: the file is no such model, or another kind of depth was asked for.
    """
    if path is None:
        return None
    if depth != "disparity":
        raise InputError(
            f"--depth-model is for --depth disparity, and --depth is {depth}. Leave one away."
        )
    return DepthSensorModel.load(path)


def radius_of(name: str, radius: str | None) -> tuple[float, float]:
    """Return the cameras' distances of `--range` and `--radius` [m]."""
    return RANGES[name] if radius is None else range_of("--radius", radius, "1-2 (metres)")


def require_usable(request: GenerateRequest) -> None:
    """Raise for what is certain to fail later, before anything is written.

    Raises:
        InputError: no mesh of a pool states its unit though sizes are kept, or a panorama is none.
    """
    pool = request.scene.pool
    for source in request.pool.sources:
        kinds = sorted({Path(key).suffix.lower() for key in source.keys})
        unitless = source.kind == "meshes" and not any(k.startswith(".usd") for k in kinds)
        if unitless and pool.keep_size and pool.unit is None:
            raise InputError(
                f"--keep-size needs --unit for the pool '{source.label}': {', '.join(kinds)} files "
                "do not say what a number in them is. Give --unit m, cm, mm or inch, or leave "
                "--keep-size away for random sizes."
            )
    for path in request.looks.hdris:
        _require_panorama(path)


def _require_panorama(path: Path) -> None:
    """Raise if a file's first bytes already tell that it is no panorama; the rest is read later.

    Raises:
        InputError: its kind is another, or it is not twice as wide as high.
    """
    from realsim.rendering.procedural.hdri import ASPECT_SLACK

    with path.open("rb") as file:
        head = file.read(4096)
    magic = b"\x76\x2f\x31\x01" if path.suffix.lower() == ".exr" else b"#?"
    if not head.startswith(magic):
        raise InputError(
            f"--hdris: {path} is no {path.suffix.lower()[1:]} picture, whatever its name says. "
            "Export it again, or take it out of the folder."
        )
    if size := re.search(rb"\n-Y (\d+) \+X (\d+)\n", head):
        height, width = int(size[1]), int(size[2])
        if height < 4 or abs(width / height - 2.0) > 2 * ASPECT_SLACK:
            raise InputError(
                f"--hdris: {path} is {width}x{height}; an equirectangular panorama, twice as wide "
                "as high (such as 2048x1024), is accepted. Cube maps and mirror balls must be "
                "converted first."
            )


def claim(out: Path, request: GenerateRequest) -> None:
    """Take a folder that is there for this data set, or say why it cannot be had.

    A folder in which another request got nowhere, so that it holds no scene, is taken over.

    Raises:
        InputError: it holds a data set of another request, or something else.
    """
    note = out / REQUEST_FILE
    if note.is_file():
        found = read_object(note)
        if found.get("key") == request.key:
            return
        if any(out.glob("scene_*")) or any(out.glob(f"{LAYOUTS}/*")):
            said = list(provenance.differences(found.get("request", {}), request.told))
            differs = "; ".join(
                f"{name} ({json.dumps(was)} there, {json.dumps(now)} wanted)"
                for name, was, now in said
            )
            differs = differs or "the version of realsim's results"
            raise InputError(
                f"'{out}' holds scenes of another request; what differs: {differs}. Choose another "
                "folder, or delete this one to begin anew; the same request goes on where it "
                "stopped, also with more --scenes."
            )
    elif any(out.iterdir()):
        raise InputError(
            f"'{out}' is not empty and holds no generated scenes. Choose another folder: nothing "
            "of yours is overwritten."
        )
    value = {"format": FORMAT, "key": request.key, "version": __version__, "request": request.told}
    atomic.write_json(note, value)
