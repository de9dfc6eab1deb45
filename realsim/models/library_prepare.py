"""From a mesh as it lies in a file to a model for the library: all computed, nothing written.

Repair, at most so many faces, symmetries, convex parts, size and matter, and a verdict: whether a
person should look at the model before it is used.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Literal

import numpy as np

from realsim import __version__
from realsim.errors import DegenerateError, InputError
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.inspect import inspect_mesh
from realsim.models.model_records import (
    ConvexNote,
    ConvexParts,
    MeshReport,
    ModelProperties,
    Problem,
    ReadScan,
    Repair,
    ScaleNote,
    ScanSource,
    Symmetries,
)
from realsim.models.properties import physical_properties
from realsim.models.repair import RepairConfig, repaired
from realsim.models.simplify import deviation, simplified
from realsim.models.symmetry import SymmetryConfig, find_symmetries
from realsim.records import Mesh, ObjectModel

Step = Literal["repair", "simplify", "symmetries", "convex parts", "properties"]
STEPS: tuple[Step, ...] = ("repair", "simplify", "symmetries", "convex parts", "properties")
LIBRARIES = ("numpy", "scipy", "trimesh", "open3d-cpu", "coacd")
"""What the figures of a model depend on besides realsim."""
PERSON_NEEDED = (
    "open", "several bodies", "non-manifold", "inside-out", "inconsistent winding", "one-sided",
    "thin sheet",
)  # fmt: skip
"""Kinds of problems that, left after the repair, a person should look at."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PrepareConfig:
    """How a mesh becomes a model."""

    most_faces: int = 200_000
    """Faces kept of the surface; more are thinned out. A face of a 10 cm object is then 0.7 mm
    wide, below what a depth camera sees, and every stage stays quick."""
    with_parts: bool = True
    """Whether convex parts are made; without them the Robot School makes its own."""
    repair: RepairConfig = field(default_factory=RepairConfig)
    symmetry: SymmetryConfig = field(default_factory=SymmetryConfig)
    convex: ConvexConfig = field(default_factory=ConvexConfig)


@dataclass(frozen=True, kw_only=True, slots=True)
class Matter:
    """What is known of an object's mass: one of both, or neither."""

    density: float | None = None
    """[kg/m^3]; None with no mass either = 1000, as in the paper."""
    mass_kg: float | None = None
    """As weighed [kg]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PreparedModel:
    """A model that is ready for the library."""

    mesh: Mesh
    """Metres; the file's own units where `properties.matter` is None."""
    parts: ConvexParts | None
    properties: ModelProperties
    """Without the id, the name and the files, which the library knows."""


def source_of(scan: ReadScan, file: str) -> ScanSource:
    """Return what is kept of the file that a scan was read from."""
    return ScanSource(
        file=file,
        sha256=scan.sha256,
        unit=scan.unit,
        factor=scan.factor,
        R_up=scan.R_up,
        declared=scan.declared,
        notes=scan.notes,
    )


def prepare_mesh(
    mesh: Mesh,
    config: PrepareConfig,
    matter: Matter | None = None,
    *,
    source: ScanSource | None = None,
    scale: ScaleNote | None = None,
    step: Callable[[Step], None] = lambda _: None,
) -> PreparedModel:
    """Return a model of a mesh in metres.

    Args:
        mesh: in metres.
        config: how.
        matter: density or mass.
        source: where the mesh comes from.
        scale: who made it metric, where its file was not.
        step: called when a step begins.

    Raises:
        InputError: the mesh cannot be used, or mass and density are no positive numbers.
    """
    repair = _repaired(mesh, config, "mm", step)
    step("symmetries")
    symmetries = find_symmetries(repair.mesh, config.symmetry)
    return _prepared(
        repair, symmetries, config, matter or Matter(), source=source, scale=scale, step=step
    )


def prepare_as_it_is(
    model: ObjectModel,
    config: PrepareConfig,
    matter: Matter,
    *,
    step: Callable[[Step], None] = lambda _: None,
) -> PreparedModel:
    """Return what is missing of a model whose mesh and symmetries are kept as they are.

    Symmetries are looked for where the model states none.

    Raises:
        InputError: the mesh cannot be used, or mass and density are no positive numbers.
    """
    report = inspect_mesh(model.mesh)
    step("symmetries")
    symmetries = find_symmetries(model.mesh, config.symmetry)
    if len(model.symmetries) > 1 or model.symmetry_axes:
        symmetries = replace(
            symmetries, discrete=model.symmetries, axes=model.symmetry_axes, near=(), worst_m=0.0
        )
    repair = Repair(mesh=model.mesh, before=report, after=report)
    return _prepared(repair, symmetries, config, matter, source=None, scale=None, step=step)


def _prepared(
    repair: Repair,
    symmetries: Symmetries,
    config: PrepareConfig,
    matter: Matter,
    *,
    source: ScanSource | None,
    scale: ScaleNote | None,
    step: Callable[[Step], None],
) -> PreparedModel:
    """Return the model of a repaired mesh with its symmetries: parts, matter, verdict."""
    step("convex parts")
    parts, trouble = _parts(repair.mesh, config)
    step("properties")
    properties = physical_properties(
        repair.mesh, density=matter.density, mass_kg=matter.mass_kg, parts=parts
    )
    reasons = (*_reasons(repair, parts, config, scale), *trouble)
    made = replace(
        _judged(repair, reasons, config, source, parts),
        symmetries=symmetries,
        matter=properties,
        convex=None if parts is None else convex_note(parts),
        scale=scale,
    )
    return PreparedModel(mesh=repair.mesh, parts=parts, properties=made)


def prepare_unscaled(
    mesh: Mesh,
    config: PrepareConfig,
    *,
    source: ScanSource | None = None,
    step: Callable[[Step], None] = lambda _: None,
) -> PreparedModel:
    """Return a mesh without metric scale, repaired and judged; the rest needs metres."""
    repair = _repaired(mesh, config, "% of the size", step)
    properties = _judged(repair, _reasons(repair, None, config, None), config, source, None)
    return PreparedModel(mesh=repair.mesh, parts=None, properties=properties)


def _judged(
    repair: Repair,
    reasons: tuple[str, ...],
    config: PrepareConfig,
    source: ScanSource | None,
    parts: ConvexParts | None,
) -> ModelProperties:
    """Return what is known of a repaired mesh without its size: condition, verdict, origin."""
    return ModelProperties(
        name="",
        verdict="doubtful" if reasons else "accepted",
        reasons=reasons,
        source=source,
        before=repair.before,
        after=repair.after,
        actions=repair.actions,
        notes=_notes(source, repair, parts),
        versions=versions(),
        config=asdict(config),
    )


def convex_note(parts: ConvexParts) -> ConvexNote:
    """Return what is noted of convex parts."""
    return ConvexNote(
        parts=len(parts.parts),
        volume_ratio=parts.volume_ratio,
        method=parts.method,
        notes=parts.notes,
    )


def versions() -> dict[str, str]:
    """Return the versions that the figures of a model depend on."""
    return {"realsim": __version__} | {name: version(name) for name in LIBRARIES}


def _repaired(
    mesh: Mesh, config: PrepareConfig, unit: Literal["mm", "% of the size"],
    step: Callable[[Step], None],
) -> Repair:  # fmt: skip
    """Return the mesh repaired and with at most so many faces, and what that did to its shape."""
    step("repair")
    repair = repaired(mesh, config.repair)
    step("simplify")
    whole = repair.mesh
    if len(whole.faces) <= config.most_faces:
        return repair
    thin = simplified(whole, config.most_faces)
    away = deviation(thin, whole)
    painted = "" if whole.texture is None else ", and the texture became colours of the vertices"
    said = away * 1e3 if unit == "mm" else 100.0 * away / float(np.max(whole.extent))
    action = (
        f"{len(whole.faces)} faces thinned out to {len(thin.faces)}: the surface moved by up to "
        f"{said:.3g} {unit}{painted}."
    )
    return replace(repair, mesh=thin, actions=(*repair.actions, action))


def _parts(mesh: Mesh, config: PrepareConfig) -> tuple[ConvexParts | None, list[str]]:
    """Return the convex parts, or None and why there are none."""
    if not config.with_parts:
        return None, []
    try:
        return convex_parts(mesh, config.convex), []
    except (InputError, DegenerateError) as error:
        return None, [f"no convex parts: {error}"]


def _reasons(
    repair: Repair, parts: ConvexParts | None, config: PrepareConfig, scale: ScaleNote | None
) -> tuple[str, ...]:
    """Return why a person should look; empty: nobody need."""
    reasons = [p.text for p in repair.after.problems if _needs_a_person(p, repair.after)]
    fat, thin = config.convex.fat_ratio, config.convex.thin_ratio
    closed = repair.after.is_watertight
    if closed and parts is not None and not thin <= parts.volume_ratio <= fat:
        off = 100 * (parts.volume_ratio - 1)
        reasons.append(
            f"convex parts: their volume is {abs(off):.0f} % {'above' if off > 0 else 'below'} the "
            f"object's ({parts.method}); from {100 * (thin - 1):+.0f} to {100 * (fat - 1):+.0f} % "
            "is good for grasping."
        )
    if scale is not None and scale.verdict != "accepted":
        reasons += [f"the scale is {scale.verdict}: {r}" for r in scale.reasons or ("not said",)]
    return tuple(reasons)


def _needs_a_person(problem: Problem, report: MeshReport) -> bool:
    """Whether a problem changes what the object is taken for."""
    if problem.kind == "non-manifold" and report.is_watertight:
        return False  # faces pair up: the volume and the normals are defined all the same
    return problem.kind in PERSON_NEEDED


def _notes(source: ScanSource | None, repair: Repair, parts: ConvexParts | None) -> tuple[str, ...]:
    """Return what a user should know and need not act on."""
    notes = [] if source is None else list(source.notes)
    notes += [p.text for p in repair.after.problems if not _needs_a_person(p, repair.after)]
    return (*notes, *(() if parts is None else parts.notes))
