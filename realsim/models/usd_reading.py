"""The pieces of USD files (usd, usda, usdc, usdz), read by Pixar's library.

Meshes are taken at the default time with their transforms, instances and point instancers
included; what is invisible or a guide or proxy is left out. Materials are UsdPreviewSurface with a
texture or a plain colour; without one, `displayColor`. Surfaces of subdivision are read as their
cage.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim import errors
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.interop import import_pixar, quiet_output
from realsim.models.mesh_atlas import FileContent, Piece, placed
from realsim.models.mesh_loading import escape_error
from realsim.models.mesh_usd_materials import (
    Materials,
    corner_values,
    joined_corners,
    triangles_of,
    vertex_colors_of,
)
from realsim.models.model_records import METRES, ScanUnit, UpAxis

USD_FORMATS = (".usd", ".usda", ".usdc", ".usdz")
TEXT_FORMAT = ".usda"
TRIAL_S = 120
"""How long one file may be read [s]."""
TRIAL_MB = 1000
"""How much memory that may take beyond 30 times the file's size [MB]."""
TRIAL = """
import pathlib, resource, sys
from realsim.errors import RealsimError
from realsim.models import usd_reading as usd
path, pxr = pathlib.Path(sys.argv[1]), usd._pixar()
held = int(open("/proc/self/status").read().split("VmData:")[1].split()[0]) << 10
room = held + (usd.TRIAL_MB << 20) + 30 * path.stat().st_size
resource.setrlimit(resource.RLIMIT_DATA, (room, room))
try:
    usd._content(pxr, path)
except RealsimError as error:
    print(type(error).__name__, error)
    sys.exit(3)
"""
ONE_THREAD = {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}
"""The stacks of a thread a core would count as memory."""
UNIT_TOLERANCE = 1e-6
"""Relative difference at which metersPerUnit is one of the units: it is often a float32."""
SHOWN_PURPOSES = ("default", "render")


def load_usd(path: Path) -> FileContent:
    """Return the pieces of a USD file with all transforms applied, and what it states.

    Raises:
        InputError: the file is broken, needs a file that is missing or outside its folder, or
            states a unit that is none of m, cm, mm, inch.
        MissingLibraryError: Pixar's library is not installed.
    """
    pxr = _pixar()
    if path.suffix.lower() != TEXT_FORMAT:
        _require_survivable(path)
    return _content(pxr, path)


def _require_survivable(path: Path) -> None:
    """Read a file in a process of its own first: at damaged ones the library ends the process.

    Raises:
        InputError: it does, needs longer than anybody waits, or says what is wrong with the file.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", TRIAL, str(path)], capture_output=True, timeout=TRIAL_S,
            check=False, text=True, errors="replace", env=os.environ | ONE_THREAD,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"{path} cannot be read as a USD file: its library takes more than {TRIAL_S} s."
        ) from error
    if done.returncode == 3:
        kind, _, words = done.stdout.strip().partition(" ")
        raise getattr(errors, kind, InputError)(words)
    if done.returncode < 0:
        raise InputError(
            f"{path} is damaged: the library for USD files breaks down at it (signal "
            f"{signal.Signals(-done.returncode).name}). Export it again, or as .usda or .glb."
        )


def _content(pxr: Any, path: Path) -> FileContent:
    notes: list[str] = []
    with quiet_output():  # the library prints its warnings straight to stderr
        try:
            _check_layers(pxr, path)
            stage = pxr.Usd.Stage.Open(str(path.resolve()), pxr.Usd.Stage.LoadAll)
            _check_used(path, stage)
            declared, unit, up = _stated(pxr, path, stage, notes)
            pieces = list(_Reader(pxr, path, notes).pieces(stage))
        except InputError:
            raise
        except Exception as error:  # Tf.ErrorException and whatever its arrays trip over
            raise InputError(
                f"{path} cannot be read as a USD file ({_reason(error)}). Export it again; meshes "
                "with points and faces are needed."
            ) from error
    return FileContent(
        pieces=tuple(pieces), declared=declared, notes=tuple(notes), up=up, unit=unit
    )


def _reason(error: Exception) -> str:
    """Return what an exception says in its last line; its own text may not be text at all."""
    try:
        lines = str(error).strip().splitlines()
    except UnicodeDecodeError:
        lines = []
    return lines[-1].strip() if lines and lines[-1].strip() else type(error).__name__


def _pixar() -> Any:
    modules = ("Usd", "UsdGeom", "UsdShade", "Sdf", "Ar")
    return import_pixar(modules, "reading USD", "A mesh in a GLB is read without it.")


# --- files that a file names ---------------------------------------------------------------------


def _is_beside(path: Path, target: str) -> bool:
    return Path(target).resolve().is_relative_to(path.resolve().parent)


def _check_layers(pxr: Any, path: Path) -> None:
    """Follow sublayers, references and payloads without opening any outside the folder.

    Raises:
        InputError: one leads out of the folder, or is missing.
    """
    todo, seen = [str(path.resolve())], set[str]()
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        layer = pxr.Sdf.Layer.FindOrOpen(name)
        if layer is None:
            raise InputError(
                f"{path} cannot be read as a USD file: '{name}' is missing or broken. Put the "
                "files that it names beside it, or export it as one usdz."
            )
        for dependency in layer.GetCompositionAssetDependencies():
            if not dependency:
                continue
            absolute = str(layer.ComputeAbsolutePath(dependency))
            outer = pxr.Ar.SplitPackageRelativePathOuter(absolute)[0]
            if "://" in dependency or not _is_beside(path, outer):
                raise escape_error(path, [str(dependency)])
            todo.append(absolute)


def _check_used(path: Path, stage: Any) -> None:
    """Raise if a layer came from outside the folder by a search path after all."""
    outside = [
        layer.realPath
        for layer in stage.GetUsedLayers()
        if layer.realPath and not _is_beside(path, layer.realPath.split("[")[0])
    ]
    if outside:
        raise escape_error(path, outside)


# --- what the stage states -----------------------------------------------------------------------


def _stated(
    pxr: Any, path: Path, stage: Any, notes: list[str]
) -> tuple[dict[str, str], ScanUnit | None, UpAxis]:
    """Return what the stage states, its unit and its up axis.

    Raises:
        InputError: metersPerUnit is none of the units.
    """
    up: UpAxis = "z" if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z else "y"
    declared = {"format": path.suffix.lower()[1:]}
    root = stage.GetRootLayer()
    if root.comment or root.documentation:
        declared["generator"] = str(root.documentation or root.comment).strip().splitlines()[0]
    if stage.HasAuthoredMetadata(pxr.UsdGeom.Tokens.upAxis):
        declared["up"] = up
    else:
        notes.append("the file states no upAxis: y, USD's fallback, is taken.")
    if not stage.HasAuthoredMetadata(pxr.UsdGeom.Tokens.metersPerUnit):
        notes.append("the file states no metersPerUnit.")
        return declared, None, up
    metres = float(pxr.UsdGeom.GetStageMetersPerUnit(stage))
    declared["unit"] = f"metersPerUnit {metres:g}"
    for unit, length in METRES.items():
        if abs(metres - length) <= UNIT_TOLERANCE * length:
            return declared, unit, up
    raise InputError(
        f"{path} states metersPerUnit {metres:g}; 1 (m), 0.01 (cm), 0.001 (mm) and 0.0254 (inch) "
        "are accepted. Export it in one of them."
    )


# --- meshes --------------------------------------------------------------------------------------


class _Reader:
    """Reads the meshes below a stage."""

    def __init__(self, pxr: Any, path: Path, notes: list[str]) -> None:
        self._pxr, self._notes = pxr, notes
        self._transforms = pxr.UsdGeom.XformCache(pxr.Usd.TimeCode.Default())
        self._materials = Materials(pxr, path, notes)
        self._ignored: dict[str, int] = {}

    def pieces(self, stage: Any) -> Iterator[Piece]:
        """Yield the pieces of the stage in its own units and axes."""
        yield from self._below(stage.GetPseudoRoot(), np.eye(4))
        for kind, n in self._ignored.items():
            self._notes.append(f"{n} prims of type {kind} were left out: only meshes are read.")

    def _below(self, root: Any, outer: Array) -> Iterator[Piece]:
        """Yield the pieces at and below a prim, moved by `outer` (4, 4) after their transforms."""
        Usd, UsdGeom = self._pxr.Usd, self._pxr.UsdGeom
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
        for prim in prims:
            imageable = UsdGeom.Imageable(prim)
            if imageable and imageable.ComputeVisibility() == UsdGeom.Tokens.invisible:
                self._ignored["invisible"] = self._ignored.get("invisible", 0) + 1
                prims.PruneChildren()
            elif imageable and imageable.ComputePurpose() not in SHOWN_PURPOSES:
                prims.PruneChildren()
            elif prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()  # its prototypes appear where it puts them, nowhere else
                yield from self._instanced(prim, outer)
            elif prim.IsA(UsdGeom.Mesh):
                yield from self._placed(prim, outer)
            elif prim.IsA(UsdGeom.Gprim):
                kind = str(prim.GetTypeName())
                self._ignored[kind] = self._ignored.get(kind, 0) + 1

    def _matrix(self, prim: Any) -> Array:
        """Return local-to-world (4, 4) for columns; USD's matrices act on rows."""
        return np.array(self._transforms.GetLocalToWorldTransform(prim), dtype=np.float64).T

    def _placed(self, prim: Any, outer: Array) -> Iterator[Piece]:
        matrix = outer @ self._matrix(prim)
        for piece in self._mesh(prim):
            moved, is_mirrored = placed(piece, matrix)
            if is_mirrored:
                self._notes.append(
                    f"'{prim.GetPath()}' is mirrored by its transform; its faces were turned so "
                    "that the outside stays outside."
                )
            yield moved

    def _instanced(self, prim: Any, outer: Array) -> Iterator[Piece]:
        """Yield what a point instancer makes of its prototypes."""
        UsdGeom = self._pxr.UsdGeom
        instancer = UsdGeom.PointInstancer(prim)
        time = self._pxr.Usd.TimeCode.Default()
        # The prototypes' own root transforms stay in; their parents' do not count.
        matrices = instancer.ComputeInstanceTransformsAtTime(
            time, time, UsdGeom.PointInstancer.IncludeProtoXform
        )
        mask = instancer.ComputeMaskAtTime(time)
        numbers = [i for i in instancer.GetProtoIndicesAttr().Get()]
        if mask:
            numbers = [i for i, keep in zip(numbers, mask, strict=True) if keep]
        paths = instancer.GetPrototypesRel().GetForwardedTargets()
        here = outer @ self._matrix(prim)
        for number, matrix in zip(numbers, matrices, strict=True):
            prototype = prim.GetStage().GetPrimAtPath(paths[number])
            below = np.linalg.inv(self._matrix(prototype))
            yield from self._below(prototype, here @ np.array(matrix, dtype=np.float64).T @ below)

    def _mesh(self, prim: Any) -> Iterator[Piece]:
        """Yield the pieces of one mesh, one per material, in its own coordinates."""
        mesh = self._pxr.UsdGeom.Mesh(prim)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or (), dtype=np.int64)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get() or (), dtype=np.int64)
        points = np.array(mesh.GetPointsAttr().Get() or (), dtype=np.float64).reshape(-1, 3)
        if len(points) == 0 or len(counts) == 0:
            self._notes.append(f"'{prim.GetPath()}' has no faces; it was left out.")
            return
        if counts.sum() != len(indices) or indices.min() < 0 or indices.max() >= len(points):
            raise InputError(
                f"the faces of '{prim.GetPath()}' name {counts.sum()} corners and vertices up to "
                f"{indices.max()}, but it has {len(indices)} corners and {len(points)} points: the "
                "file is broken. Export it again."
            )
        corners, face_of = triangles_of(counts, mesh.GetHoleIndicesAttr().Get() or ())
        if mesh.GetOrientationAttr().Get() == self._pxr.UsdGeom.Tokens.leftHanded:
            corners = corners[:, ::-1]
            self._notes.append(f"'{prim.GetPath()}' is wound left-handed; its faces were turned.")
        scheme = mesh.GetSubdivisionSchemeAttr()
        if scheme.HasAuthoredValue() and scheme.Get() != self._pxr.UsdGeom.Tokens.none:
            self._notes.append(
                f"'{prim.GetPath()}' is a subdivision surface ({scheme.Get()}); its cage is read."
            )
        primvars = self._pxr.UsdGeom.PrimvarsAPI(prim)
        for faces, material in self._materials.parts(prim, len(counts)):
            rows = np.ones(len(face_of), bool) if faces is None else np.isin(face_of, faces)
            if not np.any(rows):
                continue
            mine = corners[rows]
            piece = Piece(
                name=str(prim.GetPath()),
                vertices=points,
                faces=indices[mine].astype(np.int32),
                color=material.color,
            )
            uv = corner_values(primvars, material.uv_name, indices, face_of[rows], mine)
            if material.image is not None and uv is not None:
                yield self._materials.textured(piece, uv, material)
                continue
            if material.image is not None:
                self._notes.append(
                    f"'{prim.GetPath()}' has a texture but no '{material.uv_name}': left out."
                )
            colors = corner_values(primvars, "displayColor", indices, face_of[rows], mine)
            if colors is not None and material.color is None:
                piece = vertex_colors_of(piece, colors)
            yield replace(joined_corners(piece), name=piece.name)
