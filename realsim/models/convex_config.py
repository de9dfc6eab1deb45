"""How finely a mesh is cut into convex parts, and how long that may take."""

from dataclasses import dataclass

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class ConvexConfig:
    """How finely a mesh is cut."""

    hull_ratio: float = 1.03
    """A mesh whose hull is at most so much larger is taken for convex [-]."""
    thresholds: tuple[float, ...] = (0.1, 0.05, 0.02)
    """CoACD's concavity thresholds [-], tried in turn until the parts are as large as the mesh.
    Its own default is 0.05; a mug's wall needs 0.02. The coarse one is cheap: it is what is left
    when the time is over."""
    coarse_ratio: float = 1.03
    """What `fat_ratio` is for the first of several thresholds [-]. A stepped shaft in one part is
    only 7 % too large, but has no step left to grasp; within 3 % a finer cut changes nothing."""
    fat_ratio: float = 1.10
    """Largest volume of the parts / volume of the mesh that is accepted before the last threshold:
    a cup whose wall is a third too thick pushes the fingers away while they close."""
    thin_ratio: float = 0.90
    """The least such ratio: fingers close on air where a part of the object is missing."""
    mcts_iterations: int = 20
    """Tree search iterations per cut; CoACD's default of 150 takes minutes on a mug."""
    mcts_nodes: int = 10
    """Candidate planes per axis; half of CoACD's default."""
    mcts_depth: int = 2
    """Cuts looked ahead; CoACD's default is 3."""
    preprocess_resolution: int = 30
    """Voxels per axis when a mesh that is not watertight is closed first."""
    max_faces: int = 6000
    """Triangles given to CoACD, whose time grows with them; meshes of more are thinned first."""
    max_parts: int = 128
    """Convex parts at most; a mug takes 60. The engines' time grows with them."""
    max_vertices: int = 64
    """Vertices kept per part: those farthest out in so many evenly spread directions."""
    most_vertices: int = 256
    """Vertices at most where the parts would be smaller than the mesh by `vertex_loss`."""
    vertex_loss: float = 0.03
    """Share of the volume that leaving vertices out may cost [-]: 0.5 mm of a 6 cm can's radius.
    64 vertices of a capsule lose 8 %."""
    time_limit_s: float = 180.0
    """CPU time for all thresholds together [s]; then the best parts found so far are taken.
    A flange with seven bores takes 70 on a busy machine, and its parts must not hang on that."""
    seed: int = 0
    """CoACD's own seed."""

    def __post_init__(self) -> None:
        """Check what bounds the time and the number of parts."""
        if not self.time_limit_s > 0:
            raise InputError(f"the time limit is {self.time_limit_s} s; a positive one is needed.")
        if self.most_vertices < self.max_vertices or not 0 <= self.vertex_loss < 1:
            raise InputError(
                f"{self.max_vertices} vertices per part, at most {self.most_vertices} where a "
                f"share of {self.vertex_loss:g} of the volume is lost, contradict each other; "
                "max_vertices <= most_vertices and 0 <= vertex_loss < 1 are needed (64, 256, 0.03)."
            )
        if self.max_parts < 1 or self.max_vertices < 4 or self.max_faces < 4:
            raise InputError(
                f"at most {self.max_parts} parts of {self.max_vertices} vertices, from "
                f"{self.max_faces} faces, hold no solid; at least 1, 4 and 4 are needed."
            )
        if not self.thresholds or not all(0.01 <= t <= 1 for t in self.thresholds):
            raise InputError(
                f"the concavity thresholds are {self.thresholds}; CoACD takes one or more from "
                "0.01 to 1 (0.05)."
            )
