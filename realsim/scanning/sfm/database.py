"""Features and matches in COLMAP's database: kept, so that a killed run goes on where it stopped.

The database belongs to the images, the camera, the masks and the settings that made it; a note
beside it holds their hash. When the hash differs, it is begun anew.

Which images to match: all pairs, or those that may see the same where poses are known.

The photographs that go in: found, of one size, readable, each one named that is not.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask, evenly
from realsim.errors import DegenerateError, InputError
from realsim.images import image_size, read_grey
from realsim.interop import colmap_from_opencv_px, quiet_output
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.config import FeatureConfig, SfmConfig
from realsim.scanning.sfm.result import Matching
from realsim.store.atomic import write_bytes, write_json, write_text

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Files that are taken for photographs."""
LEAST_VIEWS = 3
"""Two views have no scale check, and their reconstruction no redundancy."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Photographs:
    """Images of one camera."""

    root: Path
    """Folder that the names are relative to."""
    names: tuple[str, ...]
    size: tuple[int, int]
    """(width, height) [px]."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files."""
        return tuple(self.root / name for name in self.names)


def photographs_in(folder: Path) -> list[Path]:
    """Return the images of a folder by name, from its rgb/ or images/ where those exist.

    Raises:
        InputError: the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise InputError(
            f"'{folder}' is not a folder; a session or a folder of photographs is expected."
        )
    for place in (folder, folder / "rgb", folder / "images", folder / "color"):
        if place.is_dir():
            found = sorted(p for p in place.iterdir() if p.suffix.lower() in ENDINGS)
            if found:
                return found
    raise InputError(
        f"'{folder}' holds no images ({', '.join(e[1:] for e in ENDINGS)}), nor do rgb/, images/ "
        "or color/ in it. Give the folder that the photographs lie in, or a session."
    )


def checked_photographs(paths: Sequence[Path]) -> Photographs:
    """Return the photographs after reading each one whole.

    Raises:
        InputError: fewer than 3, one that cannot be read, or several sizes.
    """
    if len(paths) < LEAST_VIEWS:
        raise InputError(
            f"{len(paths)} photograph(s) were given; structure from motion needs {LEAST_VIEWS} at "
            "least, and 15 or more around the object for a scale that can be checked."
        )
    sizes: dict[tuple[int, int], list[str]] = {}
    for path in paths:
        read_grey(path)  # a header alone does not tell a file that was cut off
        sizes.setdefault(image_size(path), []).append(path.name)
    if len(sizes) > 1:
        told = "; ".join(
            f"{len(v)} of {w}x{h} ({', '.join(v[:3])}{', ...' if len(v) > 3 else ''})"
            for (w, h), v in sorted(sizes.items(), key=lambda item: -len(item[1]))
        )
        raise InputError(
            f"the photographs have different sizes: {told}. One camera at one resolution is "
            "expected: take the others out, or run them by themselves."
        )
    root = Path(os.path.commonpath([p.resolve().parent for p in paths]))
    names = tuple(p.resolve().relative_to(root).as_posix() for p in paths)
    return Photographs(root=root, names=names, size=next(iter(sizes)))


def images_digest(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of files by name and content."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


Tick = Callable[[int, int], None]

DATABASE, NOTE, PAIRS, MASKS = "database.db", "database.json", "pairs.txt", "masks"
PAIRS_AT_ONCE = 24
"""Pairs matched between two looks at the clock: what a kill costs at most."""
LEAST_FEATURES = 20
"""An image with fewer features matches nothing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MatchDatabase:
    """A database on disk and what is in it."""

    path: Path
    photographs: Photographs
    image_ids: tuple[int, ...]
    """Number in the database of each photograph."""
    peak_threshold: float


def colmap_camera(intrinsics: CameraIntrinsics | None, size: tuple[int, int], model: str) -> Any:
    """Return a pycolmap.Camera: PINHOLE, OPENCV or FULL_OPENCV, or a guess of `model`.

    A guess has the focal length 1.2 x the longer side, COLMAP's own, which it then refines.
    """
    import pycolmap

    if intrinsics is None:
        return pycolmap.Camera.create_from_model_name(1, model, 1.2 * max(size), *size)
    i, d = intrinsics, intrinsics.distortion
    name = "PINHOLE" if not i.is_distorted else "FULL_OPENCV" if np.any(d[4:]) else "OPENCV"
    camera = pycolmap.Camera.create_from_model_name(1, name, i.fx, i.width, i.height)
    centre = colmap_from_opencv_px([i.cx, i.cy])
    terms = {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}[name]
    camera.params = [i.fx, i.fy, *centre.tolist(), *d[:terms].tolist()]
    camera.has_prior_focal_length = True
    return camera


def build_database(
    photographs: Photographs,
    intrinsics: CameraIntrinsics | None,
    config: SfmConfig,
    folder: Path,
    masks: Mapping[str, Mask] | None,
    tick: Tick,
) -> MatchDatabase:
    """Extract the features of every image, those done before left as they are.

    Args:
        photographs: the images.
        intrinsics: their camera, None where not known.
        config: features, seed.
        folder: where the database lies.
        masks: {name: (H, W) True where features may lie}.
        tick: called with (images done, images).

    Raises:
        DegenerateError: the images have hardly any texture; names which.
    """
    import pycolmap

    pycolmap.set_random_seed(config.seed)
    folder.mkdir(parents=True, exist_ok=True)
    note = _claim(photographs, intrinsics, config, folder, masks)
    path = folder / DATABASE
    with pycolmap.Database.open(str(path)) as database:
        if database.num_cameras() == 0:
            size, model = photographs.size, config.mapping.unknown_camera
            database.write_camera(colmap_camera(intrinsics, size, model))
        done = {str(image.name) for image in database.read_all_images()}
    reader = pycolmap.ImageReaderOptions()
    reader.existing_camera_id = 1
    if masks:
        reader.mask_path = str(folder / MASKS)
    for k, name in enumerate(photographs.names):
        if name not in done:
            with quiet_output():
                pycolmap.extract_features(
                path, photographs.root, image_names=[name], camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader, extraction_options=_sift(config, note["peak_threshold"]),
            )  # fmt: skip
        tick(k + 1, len(photographs.names))
    with pycolmap.Database.open(str(path)) as database:
        ids = {str(image.name): int(image.image_id) for image in database.read_all_images()}
    found = MatchDatabase(
        path=path,
        photographs=photographs,
        image_ids=tuple(ids[name] for name in photographs.names),
        peak_threshold=note["peak_threshold"],
    )
    _require_texture(found, bool(masks))
    return found


def match_pairs(
    database: MatchDatabase, pairs: Sequence[tuple[int, int]], config: SfmConfig, tick: Tick
) -> Matching:
    """Match and verify pairs of images, those done before left as they are.

    Args:
        database: with features.
        pairs: places in the list of photographs.
        config: matching, seed.
        tick: called with (pairs done, pairs).
    """
    import pycolmap

    f, names = config.features, database.photographs.names
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = f.threads
    matching.sift.max_ratio = f.max_ratio
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = f.min_inliers
    verification.ransac.max_error = f.verify_px
    verification.ransac.random_seed = config.seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(database.path.parent / PAIRS)
    for first in range(0, len(pairs), PAIRS_AT_ONCE):
        part = pairs[first : first + PAIRS_AT_ONCE]
        write_text(pairing.match_list_path, "".join(f"{names[i]} {names[j]}\n" for i, j in part))
        with quiet_output():
            pycolmap.match_image_pairs(
            database.path, matching_options=matching, pairing_options=pairing,
            verification_options=verification,
        )  # fmt: skip
        tick(first + len(part), len(pairs))
    return read_matching(database, pairs)


def read_matching(database: MatchDatabase, pairs: Sequence[tuple[int, int]]) -> Matching:
    """Return the numbers of features, matches and verified matches."""
    import pycolmap

    ids = database.image_ids
    with pycolmap.Database.open(str(database.path)) as db:
        features = tuple(int(db.num_keypoints_for_image(i)) for i in ids)
        matched = _by_pair(*db.read_num_matches())
        verified = _by_pair(*db.read_two_view_geometry_num_inliers())
    rows: list[tuple[int, int, int, int]] = []
    for i, j in pairs:
        key = frozenset((ids[i], ids[j]))
        rows.append((i, j, matched.get(key, 0), verified.get(key, 0)))
    return Matching(
        names=database.photographs.names, features=features, pairs=tuple(rows),
        peak_threshold=database.peak_threshold,
    )  # fmt: skip


def _by_pair(pair_ids: Sequence[int], counts: Sequence[int]) -> dict[frozenset[int], int]:
    import pycolmap

    return {
        frozenset(int(i) for i in pycolmap.pair_id_to_image_pair(pair)): int(n)
        for pair, n in zip(pair_ids, counts, strict=True)
    }


def _claim(
    photographs: Photographs,
    intrinsics: CameraIntrinsics | None,
    config: SfmConfig,
    folder: Path,
    masks: Mapping[str, Mask] | None,
) -> dict[str, Any]:
    """Return the note of the database that fits these inputs; another one is deleted."""
    import pycolmap

    digest = hashlib.sha256(images_digest(photographs.paths).encode())
    camera = colmap_camera(intrinsics, photographs.size, config.mapping.unknown_camera)
    settings = {k: v for k, v in asdict(config.features).items() if k != "threads"}
    settings |= {"seed": config.seed, "version": pycolmap.__version__}
    settings |= {"camera": [camera.model_name, *map(float, camera.params)]}
    digest.update(json.dumps(settings, sort_keys=True).encode())
    for name in sorted(masks or {}):
        digest.update(name.encode() + np.packbits((masks or {})[name]).tobytes())
    key, path = digest.hexdigest(), folder / NOTE
    if path.is_file() and (folder / DATABASE).is_file():
        note = json.loads(path.read_text())
        if note.get("key") == key:
            return note
    for stale in folder.glob(f"{DATABASE}*"):
        stale.unlink()
    for name, mask in (masks or {}).items():
        from realsim.images import png_bytes

        # COLMAP's rule: the mask of a.png is a.png.png, black where no feature may lie.
        image = mask.astype(np.uint8) * np.uint8(255)
        write_bytes(folder / MASKS / f"{name}.png", png_bytes(image), flush=False)
    note = {"key": key, "peak_threshold": _chosen_threshold(photographs, config)}
    write_json(path, note)
    return note


def _chosen_threshold(photographs: Photographs, config: SfmConfig) -> float:
    """Return the highest contrast threshold that gives enough features in a few images."""
    import pycolmap

    from realsim.images import read_grey

    f, paths = config.features, photographs.paths
    images = [np.ascontiguousarray(read_grey(p)) for p in evenly(paths, f.probe_images)]
    for threshold in f.peak_thresholds[:-1]:
        with quiet_output():
            extractor: Any = pycolmap.FeatureExtractor.create(_sift(config, threshold))
        counts = [len(extractor.extract_from_uint8_array(image)[0]) for image in images]
        if np.median(counts) >= f.wanted_features:
            return threshold
    return f.peak_thresholds[-1]


def _sift(config: SfmConfig, threshold: float) -> Any:
    """Return COLMAP's extraction options."""
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = config.features.threads
    options.use_gpu = False
    options.sift.max_num_features = config.features.most_features
    options.sift.first_octave = config.features.first_octave
    options.sift.peak_threshold = threshold
    return options


def _require_texture(database: MatchDatabase, masked: bool) -> None:
    """Raise if hardly any image has features."""
    counts = read_matching(database, ()).features
    names = database.photographs.names
    bare = [f"{n} ({c})" for n, c in zip(names, counts, strict=True) if c < LEAST_FEATURES]
    if len(names) - len(bare) < 3:
        where = "in the masked parts of " if masked else "in "
        raise DegenerateError(
            f"there is no texture {where}{len(bare)} of {len(names)} photographs: "
            f"{', '.join(bare[:8])}{', ...' if len(bare) > 8 else ''} features, {LEAST_FEATURES} "
            "are the least and 1000 are good. Put newspaper or the tag board under the object, "
            "check exposure and focus, and take the photographs again."
        )


# --- which images to match -----------------------------------------------------------------------


def pairs_to_match(
    count: int, Ts_world_cam: Array | None, config: FeatureConfig
) -> list[tuple[int, int]]:
    """Return pairs of image numbers (i < j), in order.

    Without poses all pairs; with poses those whose optical axes differ by at most
    `max_angle_deg`, and, where there are many views, of each view the `neighbours` nearest by the
    angle plus the distance of the centres over the spread of all. Each view keeps its nearest two
    whatever the angle, so that none is left out by a wrong pose.

    Args:
        count: images.
        Ts_world_cam: (count, 4, 4) camera poses [m], rough ones do; None where not known.
        config: angles and numbers.
    """
    every = list(combinations(range(count), 2))
    if Ts_world_cam is None:
        return every
    axes, centres = Ts_world_cam[:, :3, 2], Ts_world_cam[:, :3, 3]
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    spread = max(float(np.median(distance)), 1e-9)
    # One spread of the centres counts as much as 30 deg: on a hemisphere they go together.
    cost = angle + 30.0 * distance / spread
    np.fill_diagonal(cost, np.inf)
    order = np.argsort(cost, axis=1, kind="stable")
    near = np.zeros((count, count), dtype=bool)
    most = count if count <= config.exhaustive_up_to else config.neighbours
    for i in range(count):
        chosen = [j for j in order[i, :most] if angle[i, j] <= config.max_angle_deg and j != i]
        near[i, chosen] = True
        near[i, order[i, : min(2, count - 1)]] = True
    near |= near.T
    return [(i, j) for i, j in every if near[i, j]]
