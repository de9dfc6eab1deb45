"""A material out of the pictures of a texture pack, told apart by their names."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Image
from realsim.errors import InputError
from realsim.geometry.colors import srgb_encoded
from realsim.rendering.appearance import LEAST_ROUGHNESS, Material
from realsim.rendering.procedural.hdri import HDR, PICTURES, read_picture

LARGEST_PX = 2048
"""Larger pictures are reduced to this."""
PLAIN_ROUGHNESS = 0.6
"""Where a pack has no roughness: as most dry, painted or wooden surfaces."""
WORDS: dict[str, tuple[str, ...]] = {
    "color": ("diff", "diffuse", "albedo", "basecolor", "color", "colour", "col", "base"),
    "roughness": ("rough", "roughness"),
    "gloss": ("gloss", "glossiness", "smoothness"),
    "normal": ("normal", "nor", "normalgl", "norgl", "nrm"),
    "normal_dx": ("normaldx", "nordx"),
    "metallic": ("metal", "metallic", "metalness"),
    "packed": ("arm", "orm"),
}
"""Last words of the file names of each kind of map; packed = occlusion, roughness, metal."""
UNUSED = ("ao", "occlusion", "ambientocclusion", "disp", "displacement", "height", "bump", "spec",
          "specular", "opacity", "mask", "translucency", "preview", "thumb")  # fmt: skip
"""Maps that packs hold and materials here have no use for."""
SIZES = ("1k", "2k", "4k", "8k", "16k", "gl", "dx", "png", "jpg", "tiff", "8bit", "16bit", "v1",
         "01", "1")  # fmt: skip


def material_from_images(
    source: Path | str | Sequence[Path | str], period_m: float, notes: list[str] | None = None
) -> Material:
    """Return a material out of a folder of maps, a list of them, or one picture.

    Maps are known by the end of their names, as Poly Haven, ambientCG and others write them:
    wood_diff_2k.jpg, wood_rough_2k.png, wood_nor_gl_2k.png, Wood_Color.png, Wood_Metalness.png.

    Args:
        source: the folder or the files. A single picture is the base colour, whatever its name.
        period_m: edge of one tile [m]; the width of the picture.
        notes: which maps are missing and what stands for them is added to it.

    Raises:
        InputError: nothing there, no base colour, two files for one map, or a broken file.
    """
    notes = [] if notes is None else notes
    paths, name = _paths(source)
    pack = _sorted(paths, name)
    color = read_picture(pack["color"])
    rough, base_roughness = _roughness(pack, name, notes)
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=_square(_rgb8(color), pack["color"], notes),
        roughness=base_roughness,
        roughness_image=rough,
        metallic=_metallic(pack, name, notes),
        normal_image=_normal(pack, name, notes),
        projection="box",
        period_m=period_m,
        name=name,
    )


def _paths(source: Path | str | Sequence[Path | str]) -> tuple[list[Path], str]:
    """Return the picture files of a source, and what to call it.

    Raises:
        InputError: nothing there.
    """
    if not isinstance(source, str | Path):
        paths = [Path(p) for p in source]
        if not paths:
            raise InputError("no picture was given; a material needs at least its base colour.")
        return paths, paths[0].stem
    path = Path(source)
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in (*PICTURES, *HDR))
        if not found:
            raise InputError(
                f"{path} holds no picture; maps such as wood_diff.png and wood_rough.png are "
                f"expected there ({', '.join((*PICTURES, *HDR))})."
            )
        return found, path.name
    if not path.exists():
        raise InputError(f"{path} does not exist; a picture or a folder of them was expected.")
    return [path], path.stem


def kind_of(path: Path) -> str | None:
    """Return which map a file is, by the end of its name; None = it does not tell."""
    stem = path.stem.replace("-", "_").replace(" ", "_").replace(".", "_")
    split = "".join(f"_{c}" if c.isupper() and k and stem[k - 1].islower() else c
                    for k, c in enumerate(stem))  # fmt: skip
    words = [w for w in split.lower().split("_") if w]
    is_dx = "dx" in words or any(w.endswith("dx") for w in words[-2:])
    while len(words) > 1 and words[-1] in SIZES:
        words.pop()
    for tail in (words[-1], "".join(words[-2:])):
        if tail in UNUSED:
            return "unused"
        for kind, endings in WORDS.items():
            if tail in endings:
                return "normal_dx" if kind == "normal" and is_dx else kind
    return None


def _sorted(paths: Sequence[Path], name: str) -> dict[str, Path]:
    """Return the files by the map they are.

    Raises:
        InputError: two files for one map, or none for the base colour.
    """
    pack: dict[str, Path] = {}
    unnamed: list[Path] = []
    for path in paths:
        kind = kind_of(path)
        if kind == "unused":
            continue
        if kind is None:
            unnamed.append(path)
        elif kind in pack:
            raise InputError(
                f"material '{name}': both {pack[kind].name} and {path.name} are its {kind}. "
                "Give one pack at a time, in one size."
            )
        else:
            pack[kind] = path
    if "color" not in pack:
        # A picture whose name tells nothing is the base colour, if it is the only one.
        alone = list(paths) if len(paths) == 1 else unnamed
        if len(alone) != 1:
            raise InputError(
                f"material '{name}': none of {', '.join(p.name for p in paths)} is the base "
                f"colour; a name that ends in {', '.join(WORDS['color'])} is."
            )
        pack = {k: p for k, p in pack.items() if p != alone[0]}
        pack["color"] = alone[0]
    return pack


def _roughness(pack: dict[str, Path], name: str, notes: list[str]) -> tuple[Image | None, float]:
    """Return the roughness image and the factor of it."""
    for kind in ("roughness", "gloss", "packed"):
        path = pack.get(kind)
        if path is None:
            continue
        image = _rgb8(read_picture(path), linear=True)
        grey = image[..., 1] if kind == "packed" else image[..., 0]
        return _square(255 - grey if kind == "gloss" else grey, path, notes), 1.0
    notes.append(f"material '{name}' has no roughness map; it is {PLAIN_ROUGHNESS} all over.")
    return None, max(PLAIN_ROUGHNESS, LEAST_ROUGHNESS)


def _metallic(pack: dict[str, Path], name: str, notes: list[str]) -> float:
    """Return how much of the material is metal."""
    if "metallic" not in pack and "packed" not in pack:
        notes.append(f"material '{name}' has no metallic map; it is no metal.")
        return 0.0
    own = "metallic" in pack
    image = _rgb8(read_picture(pack["metallic" if own else "packed"]), linear=True)
    share = image[..., 0 if own else 2].astype(np.float64) / 255.0
    if float(share.std()) > 0.1:
        notes.append(
            f"material '{name}' is metal in places only; its mean, {share.mean():.2f}, is taken "
            "all over."
        )
    return float(share.mean())


def _normal(pack: dict[str, Path], name: str, notes: list[str]) -> Image | None:
    """Return the normal image with OpenGL's y up."""
    for kind in ("normal", "normal_dx"):
        path = pack.get(kind)
        if path is None:
            continue
        try:
            image = read_picture(path)
        except InputError as error:
            if path.suffix.lower() != ".exr":
                raise
            notes.append(f"material '{name}': {error} The surface is taken as flat.")
            return None
        if image.ndim == 2:
            notes.append(f"{path.name} is grey, so it holds no normals; the surface is flat.")
            return None
        normal = _rgb8(image, linear=True)
        if kind == "normal_dx":
            normal = np.stack([normal[..., 0], 255 - normal[..., 1], normal[..., 2]], -1)
        return _square(np.ascontiguousarray(normal), path, notes)
    notes.append(f"material '{name}' has no normal map; the surface is flat.")
    return None


def _rgb8(image: NDArray[Any], linear: bool = False) -> Image:
    """Return a picture as (H, W, 3) bytes; linear floats become sRGB unless asked to stay."""
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, -1)
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind == "f":
        value = np.clip(np.nan_to_num(image.astype(np.float64)), 0, 1)
        if not linear:
            value = srgb_encoded(value)
        return np.round(255 * value).astype(np.uint8)
    return np.round(image.astype(np.float64) * (255.0 / np.iinfo(image.dtype).max)).astype(np.uint8)


def _square(image: Image, path: Path, notes: list[str]) -> Image:
    """Return a picture as a square tile of at most 2048 px, its width one period.

    A picture that is a whole number of times wider than high is repeated downwards; any other is
    stretched, which is noted.
    """
    import cv2

    height, width = image.shape[:2]
    if height != width:
        times = width / height
        if width > height and abs(times - round(times)) < 0.01:
            image = np.concatenate([image] * round(times), axis=0)
        else:
            notes.append(f"{path.name} is {width}x{height}; it is stretched to a square tile.")
    side = min(width, LARGEST_PX)
    if image.shape[:2] != (side, side):
        image = np.asarray(cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(image)
