"""Matrix row-column sampling as a Mitsuba integrator."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.manylights.image import ManyLightsImage
from mi_sparse_prt.manylights.render import Settings, render_many_lights


class RowColumn(mi.SamplingIntegrator):
    r"""Matrix row-column sampling integrator (:monosp:`row_column`)
    --------------------------------------------------------------

    A preview of a scene whose light, indirect light too, is that of many points: a few hundred rows and columns of the
    matrix of samples and lights are evaluated. Nothing is precomputed; see ``prt.render_many_lights``.

    Emitters may be ``area``, ``point``, ``spot``, ``projector``, ``directional``, ``envmap``, ``constant``, ``sunsky``
    and ``cubemap``; shapes may be all that Mitsuba intersects. Samples are stratified within pixels: the film's sampler
    says how many there are by its ``sample_count``, not where.

    .. tabs::
        .. code-tab:: xml

            <integrator type="row_column">
                <integer name="rows" value="300"/>
                <integer name="columns" value="900"/>
            </integrator>

        .. code-tab:: python

            'type': 'row_column',
            'rows': 300,
            'columns': 900

    =================== ========== =============================================================================
    Parameter           Type       Meaning
    =================== ========== =============================================================================
    rows                integer    Rows that are evaluated: samples and all lights. (300)
    columns             integer    Columns that are evaluated: lights and all samples. (900)
    seconds             float      Choose both by what they cost. (0: do not)
    error               float      Raise both until the estimated error is so small, 0.02 is 2%. (0: do not)
    method              string     ``adaptive``, or ``hasan2007``: the paper as published. (adaptive)
    lights              integer    Lights in all, about. (100,000)
    max_depth           integer    As for ``path``. (5)
    clamp               float      Largest geometry term of indirect lights, see ``LightOptions``. (0: by the size of
                                   the scene)
    compensate          boolean    Add what the clamp cuts off, and light by way of mirrors and glass. (false)
    spp                 integer    Samples per pixel. (that of ``mi.render``, else of the sampler)
    progress            boolean    Show a forecast and progress bars. (false)
    =================== ========== =============================================================================
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self._settings = {
            "rows": props.get("rows", 300),
            "columns": props.get("columns", 900),
            "seconds": props.get("seconds", 0.0) or None,
            "error": props.get("error", 0.0) or None,
            "method": props.get("method", "adaptive"),
            "lights": props.get("lights", 100_000),
            "max_depth": props.get("max_depth", 5),
            "clamp": props.get("clamp", 0.0) or None,
            "compensate": props.get("compensate", False),
        }
        self._spp = props.get("spp", 0)
        self._progress = props.get("progress", False)
        Settings(**self._settings)  # complains now, not when rendering

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render a camera (world units, linear RGB); the arguments are those of every Mitsuba integrator.

        Raises
        ------
        PrtError
            See ``prt.render_many_lights``.
        """
        camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        spp = spp or self._spp or int(camera.sampler().sample_count())
        number = seed if isinstance(seed, int) else int(mi.UInt32(seed).numpy()[0])
        found = render_many_lights(
            scene, sensor=camera, progress=self._progress, spp=spp, seed=number, **self._settings
        )
        return _developed(camera.film(), found, develop)

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Mask = True,
    ) -> tuple[mi.Color3f, mi.Mask, list[mi.Float]]:
        """What integrators around this one ask for: it has no answer for single rays (PrtError)."""
        raise PrtError(
            "row_column makes whole pictures, and cannot be inside of another integrator: take aov alone"
        )

    def to_string(self) -> str:
        return f"RowColumn[{self._settings}]"


def _developed(film: mi.Film, found: ManyLightsImage, develop: bool) -> mi.TensorXf:
    """A picture in a film, in its pixel format; nothing if it is not to be developed."""
    channels = film.prepare([])
    values = np.zeros((*found.image.shape[:2], channels), np.float32)
    values[..., :3], values[..., -1] = found.image, 1  # the last channel counts samples
    if channels == 5:
        values[..., 3] = found.alpha
    block = mi.ImageBlock(mi.TensorXf(values), film.crop_offset(), rfilter=film.rfilter())
    film.put_block(block)
    return film.develop() if develop else mi.TensorXf()
