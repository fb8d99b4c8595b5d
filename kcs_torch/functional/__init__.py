"""The mathematics: plain functions of tensors with any leading batch dimensions."""

from kcs_torch.functional.align import centre, minimal_turn, nearest_rotation, procrustes, similarity
from kcs_torch.functional.camera import (
    back_project,
    camera_disagreement,
    complete_rotation,
    factorize,
    orbit,
    orthonormality_defect,
    project,
    rows_to_cameras,
    viewpoint_turn,
)
from kcs_torch.functional.chain import (
    bone_lengths,
    bone_vectors,
    chain_inverse,
    incidence,
    kcs_matrix,
    points_from_bones,
)
from kcs_torch.functional.rigidity import distance_spread, rigid_tree
from kcs_torch.functional.scatter import scatter_log_det
from kcs_torch.functional.spectral import (
    dct_basis,
    log_det,
    nuclear_norm,
    psd_shrink,
    singular_values,
    spectral_norm,
    svt,
)
from kcs_torch.functional.temporal import best_path, blend_windows, interpolate, jitter, standing, window_starts

__all__ = [
    "back_project",
    "best_path",
    "blend_windows",
    "bone_lengths",
    "bone_vectors",
    "camera_disagreement",
    "centre",
    "chain_inverse",
    "complete_rotation",
    "dct_basis",
    "distance_spread",
    "factorize",
    "incidence",
    "interpolate",
    "jitter",
    "kcs_matrix",
    "log_det",
    "minimal_turn",
    "nearest_rotation",
    "nuclear_norm",
    "orbit",
    "orthonormality_defect",
    "points_from_bones",
    "procrustes",
    "project",
    "psd_shrink",
    "rigid_tree",
    "rows_to_cameras",
    "scatter_log_det",
    "similarity",
    "singular_values",
    "spectral_norm",
    "standing",
    "svt",
    "viewpoint_turn",
    "window_starts",
]
