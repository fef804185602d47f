"""Time, error and memory on the user's own machine, every speed as a ratio to the strongest other form, in one run."""

from mi_sparse_prt.benchmark.clustered_pca import measure_cpca
from mi_sparse_prt.benchmark.gallery import draw_gallery, save_gallery
from mi_sparse_prt.benchmark.glossy_transport import measure_glossy
from mi_sparse_prt.benchmark.many_lights import measure_many_lights
from mi_sparse_prt.benchmark.method_comparison import measure_methods
from mi_sparse_prt.benchmark.moving_light import measure_moving_light
from mi_sparse_prt.benchmark.page_errors import measure_pages
from mi_sparse_prt.benchmark.plan_choice import measure_plans
from mi_sparse_prt.benchmark.row_column_choices import measure_choices
from mi_sparse_prt.benchmark.size_costs import cost_against_size
from mi_sparse_prt.benchmark.speed import run_benchmark
from mi_sparse_prt.benchmark.time_error import time_against_error
from mi_sparse_prt.benchmark.zoo import measure_zoo

__all__ = [
    "cost_against_size",
    "draw_gallery",
    "measure_choices",
    "measure_cpca",
    "measure_glossy",
    "measure_many_lights",
    "measure_methods",
    "measure_moving_light",
    "measure_pages",
    "measure_plans",
    "measure_zoo",
    "run_benchmark",
    "save_gallery",
    "time_against_error",
]
