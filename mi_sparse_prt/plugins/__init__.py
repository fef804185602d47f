"""What Mitsuba itself sees: plugins, registered for the current variant when the package is imported."""

import mitsuba as mi

from mi_sparse_prt.plugins.cubemap import CubemapEmitter
from mi_sparse_prt.plugins.glossy_bsdfs import AshikhminShirley, Phong
from mi_sparse_prt.plugins.in_out_factors import InOutFactors
from mi_sparse_prt.plugins.mesh_vertices import MeshVertices
from mi_sparse_prt.plugins.sparse_prt import SparsePRT


def register() -> None:
    """Make the plugins known to Mitsuba's XML and dict loaders."""
    mi.register_sensor("mesh_vertices", MeshVertices)
    mi.register_emitter("cubemap", CubemapEmitter)
    mi.register_integrator("sparse_prt", SparsePRT)
    mi.register_bsdf("phong", Phong)
    mi.register_bsdf("ashikhmin_shirley", AshikhminShirley)
    mi.register_bsdf("in_out_factors", InOutFactors)
