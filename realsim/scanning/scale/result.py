"""What a scale fit gives: scale and pose with covariance, what was checked, what limits it."""

from dataclasses import dataclass, field
from typing import Any

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import Mesh, SupportPlane, Verdict
from realsim.untrusted.own_json import Real


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Similarity:
    """A scale and a pose of a mesh: p_world = T_world_obj @ (scale * p_mesh)."""

    scale: float
    """Metres per unit of the mesh."""
    T_world_obj: Array
    """(4, 4) of the scaled mesh in world [m]."""
    score: Real = float("nan")
    """Score of the step that made it; greater is better. Comparable within one list only."""
    source: str = ""
    """Where it comes from, for the report: 'given', 'stable pose 2, yaw 90 deg', ..."""

    def vertices(self, mesh: Mesh) -> Array:
        """Return the mesh's vertices (V, 3) in world [m]."""
        return se3.transform(self.T_world_obj, self.scale * mesh.vertices)


@dataclass(frozen=True, kw_only=True, slots=True)
class Limit:
    """One reason why the scale is not known better."""

    name: str
    """'shape', 'depth noise', 'hand-eye', 'arm', 'mask', 'surface offset'."""
    percent: Real
    """What it alone contributes to the scale's 1-sigma [% of the scale]."""
    text: str
    """One sentence for a person, with numbers."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewAgreement:
    """How one view agrees with the fitted model."""

    index: int
    """Number of the view in its session."""
    points: int
    """Measured points of the object that were used."""
    agree: Real
    """Share of the rendered object's measured pixels whose depth agrees."""
    iou: Real
    """Overlap of the rendered and the measured mask: intersection over union."""
    rms_mm: Real
    """RMS distance of its points to the model's surface [mm]."""
    shift_mm: Real
    """By how much this view's camera was moved to agree with the others [mm]."""
    turn_deg: Real
    """By how much it was turned [deg]."""
    used: bool = True
    """False: the view speaks against the others and was left out."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScaleFit:
    """The metric scale of a mesh, with everything needed to trust it or not."""

    scale: Real
    """Metres per unit of the mesh."""
    sigma: Real
    """1-sigma of the scale, in metres per unit too; see `sigma_percent`."""
    T_world_obj: Array
    """(4, 4) pose of the scaled mesh in world [m]."""
    covariance: Array
    """(7, 7) of the right perturbation [rotation rad, translation m, log scale] about the centre of
    the mesh's box."""
    verdict: Verdict
    reasons: tuple[str, ...]
    """Why the verdict is not 'accepted'."""
    checks: dict[str, Real]
    """Named checks without ground truth: agree, cover, iou, gain, contrast, shape_mm, noise, ..."""
    limits: tuple[Limit, ...]
    """What limits the scale, worst first."""
    views: tuple[ViewAgreement, ...]
    residual_mm: Array
    """(V,) signed distance from the model's surface to the measured one at each vertex of the mesh
    [mm], positive = the real surface is outside; NaN where nothing was measured."""
    plane: SupportPlane
    """The table, in world."""
    extent_mm: Array
    """(3,) size of the mesh's box at this scale, along the mesh's own axes [mm]."""
    candidates: tuple[Similarity, ...] = ()
    """Other scales and poses that were looked at, best first."""
    history: tuple[dict[str, Any], ...] = ()
    """Steps of the fit, plain JSON values."""
    cpu_s: Real = float("nan")
    """CPU time of the fit [s]."""
    notes: tuple[str, ...] = field(default=())
    """What a user should know besides: a repaired mesh, a mirrored one, views left out."""

    @property
    def sigma_percent(self) -> float:
        """1-sigma of the scale as a percentage of it."""
        return 100.0 * self.sigma / self.scale

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the scale [metres per unit]."""
        return self.scale - 1.96 * self.sigma, self.scale + 1.96 * self.sigma
