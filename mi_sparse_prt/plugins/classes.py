"""The classes of all plugins."""

from mi_sparse_prt.plugins.cubemap import CubemapEmitter
from mi_sparse_prt.plugins.glossy_bsdfs import AshikhminShirley, Phong
from mi_sparse_prt.plugins.in_out_factors import InOutFactors
from mi_sparse_prt.plugins.mesh_vertices import MeshVertices
from mi_sparse_prt.plugins.row_column import RowColumn
from mi_sparse_prt.plugins.sparse_prt import SparsePRT

__all__ = [
    "AshikhminShirley",
    "CubemapEmitter",
    "InOutFactors",
    "MeshVertices",
    "Phong",
    "RowColumn",
    "SparsePRT",
]
